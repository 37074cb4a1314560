// A monotonic clock that goes on while the machine is suspended, unlike std::chrono::steady_clock: a leader that slept
// must not think that no time has passed.
#pragma once

#include <time.h>

#include <chrono>

namespace aureole::kubernetes {

struct BootClock {
  using duration = std::chrono::nanoseconds;
  using rep = duration::rep;
  using period = duration::period;
  using time_point = std::chrono::time_point<BootClock>;
  static constexpr bool is_steady = true;
  static time_point now() noexcept {
    timespec now{};
    clock_gettime(CLOCK_BOOTTIME, &now);
    return time_point(std::chrono::seconds(now.tv_sec) + std::chrono::nanoseconds(now.tv_nsec));
  }
};

}  // namespace aureole::kubernetes
