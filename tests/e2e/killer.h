// Kills region servers of a run at random moments, one or two at once.
#pragma once

#include <signal.h>

#include <algorithm>
#include <chrono>
#include <map>
#include <random>

#include "server/control/run_status.h"

namespace aureole {

class Killer {
 public:
  using Clock = std::chrono::steady_clock;

  // `every`: wall time between kills, on average.
  Killer(uint32_t seed, int kills, std::chrono::milliseconds every) : random_(seed), left_(kills), every_(every) {}

  // Call it often. A region that was killed is mostly left alone until it gets further than it was.
  void Look(const RunStatus& status) {
    if (status.stage != Stage::kRunning || left_ == 0) return;
    const auto now = Clock::now();
    if (next_ == Clock::time_point{}) next_ = now + every_;
    if (const Tick tick = status.MinTick(); tick != tick_) {
      if (tick_ >= 0) longest_stop_ = std::max(longest_stop_, now - moved_);
      tick_ = tick;
      moved_ = now;
    }
    if (now < next_) return;
    const int together = random_() % 4 == 0 ? 2 : 1;
    for (int i = 0; i < together && left_ > 0; ++i) {
      const size_t region = random_() % status.regions.size();
      const RegionStatus& r = status.regions[region];
      const bool further = r.report.tick() > killed_at_[region] || random_() % 4 == 0;
      if (!r.joined || !r.ready || r.left || r.pid <= 0 || !further) continue;
      killed_at_[region] = std::max(killed_at_[region], r.report.tick());
      if (kill(static_cast<pid_t>(r.pid), SIGKILL) == 0) {
        --left_;
        ++killed_;
      }
    }
    next_ = now + std::chrono::milliseconds(random_() % (2 * static_cast<uint32_t>(every_.count()) + 1));
  }

  int killed() const { return killed_; }
  // In which the slowest region did not tick, as far as its reports tell.
  std::chrono::duration<double> longest_stop() const { return longest_stop_; }

 private:
  std::mt19937 random_;
  int left_, killed_ = 0;
  const std::chrono::milliseconds every_;
  Clock::time_point next_{}, moved_{};
  Clock::duration longest_stop_{};
  Tick tick_ = -1;
  std::map<size_t, int64_t> killed_at_;  // by region: the tick
};

}  // namespace aureole
