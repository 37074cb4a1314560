#include "server/control/kubernetes/backoff.h"

#include <algorithm>
#include <condition_variable>
#include <mutex>

namespace aureole::kubernetes {

Backoff::Backoff(Duration first, Duration most, uint64_t seed)
    : first_(first), most_(most), next_(first), random_(seed) {}

Backoff::Duration Backoff::Next() {
  const Duration most = std::min(next_, most_);
  next_ = std::min(most * 2, most_);
  return Duration(std::uniform_int_distribution<Duration::rep>(most.count() / 2, most.count())(random_));
}

bool Pause(const std::stop_token& stop, std::chrono::milliseconds pause) {
  std::mutex mutex;
  std::condition_variable_any never;
  std::unique_lock lock(mutex);
  never.wait_for(lock, stop, pause, [] { return false; });
  return !stop.stop_requested();
}

}  // namespace aureole::kubernetes
