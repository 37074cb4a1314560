// Ends region servers together with their volumes, one after another, each once all regions have copies again.
#pragma once

#include <signal.h>

#include <algorithm>
#include <chrono>
#include <filesystem>
#include <string>

#include "server/control/run_status.h"

namespace aureole {

class Destroyer {
 public:
  using Clock = std::chrono::steady_clock;

  // `data`: holds region-N for each region.
  Destroyer(std::filesystem::path data, int most) : data_(std::move(data)), left_(most) {}

  static bool HasCopy(const RegionStatus& r) {
    return r.ready && r.report.copied_tick() > 0 && r.report.copy_failure().empty();
  }

  // Call it often. A server is stopped first, so that what its reports say of its copy is so when it ends.
  void Look(const RunStatus& status) {
    if (status.stage != Stage::kRunning || left_ == 0) return;
    const bool all = std::all_of(status.regions.begin(), status.regions.end(), HasCopy);
    const RegionStatus& r = status.regions[next_];
    if (stopped_ == 0 && all && r.report.tick() > tick_) {
      stopped_ = static_cast<pid_t>(r.pid);
      since_ = Clock::now();
      kill(stopped_, SIGSTOP);
    } else if (stopped_ != 0 && Clock::now() - since_ > std::chrono::milliseconds(300)) {
      if (HasCopy(r)) {
        kill(stopped_, SIGKILL);
        std::filesystem::remove_all(data_ / ("region-" + std::to_string(next_)));
        ++destroyed_;
        --left_;
        tick_ = status.MaxTick();
        next_ = (next_ + 1) % status.regions.size();
      } else {
        kill(stopped_, SIGCONT);
        tick_ = r.report.tick();
      }
      stopped_ = 0;
    }
  }

  int destroyed() const { return destroyed_; }

 private:
  const std::filesystem::path data_;
  int left_, destroyed_ = 0;
  size_t next_ = 0;
  int64_t tick_ = 0;  // all have got further than this
  pid_t stopped_ = 0;
  Clock::time_point since_{};
};

}  // namespace aureole
