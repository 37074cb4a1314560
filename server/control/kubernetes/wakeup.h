// Wakes the one thread that waits for any of several sources.
#pragma once

#include <chrono>
#include <condition_variable>
#include <mutex>

namespace aureole::kubernetes {

class Wakeup {
 public:
  // Any thread.
  void Notify() {
    {
      const std::lock_guard lock(mutex_);
      notified_ = true;
    }
    changed_.notify_one();
  }

  // Returns at once when notified since the last return; false when nothing was for `at_most`.
  bool Wait(std::chrono::milliseconds at_most) {
    std::unique_lock lock(mutex_);
    changed_.wait_for(lock, at_most, [this] { return notified_; });
    const bool out = notified_;
    notified_ = false;
    return out;
  }

 private:
  std::mutex mutex_;
  std::condition_variable changed_;
  bool notified_ = false;
};

}  // namespace aureole::kubernetes
