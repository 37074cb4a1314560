// When a world gets more regions, or fewer: by the load of its servers, as a pure function of what is seen, without a
// clock, thread or process.
//
// The load of a region is the larger share of two: its frame time (p99 of the last second) of what it may take, and its
// bodies awake of those that it may have. More regions come when that of the busiest was above 1 in every look for
// `up_after`, so many at once that each had 0.7 if all had the same; fewer when the busiest would stay below 0.5 with
// them, by what it had at most for `down_after`, where a peak that did not last `up_after` does not count. Between both
// lies what a world may do without a change. After a change, or a server that was replaced, all is seen anew, from
// `up_after` later on. Where fewer regions were too few at once, the next attempt comes after twice the time.
#pragma once

#include <chrono>
#include <cstdint>
#include <deque>
#include <optional>
#include <string>
#include <vector>

#include <absl/status/status.h>

#include "server/core/types.h"
#include "server/core/world.h"

namespace aureole {

struct ScalingOptions {
  int min_regions = 0, max_regions = 0;  // 0: the world does not scale itself
  int frame_percent = 70;                // of the tick: what the frame time of a region may be
  int64_t awake_bodies = 0;              // what a region may have; 0: any number
  std::chrono::milliseconds up_after{5000}, down_after{60000};

  bool on() const { return max_regions > 0; }

  friend bool operator==(const ScalingOptions&, const ScalingOptions&) = default;
};

// InvalidArgument "max: ...", with the remedy; the fields are min, max, framePercent, awakeBodies, upAfter, downAfter.
absl::Status CheckScaling(const ScalingOptions& options);
// FailedPrecondition: this world's layout cannot change, and these options ask for that.
absl::Status CheckScales(const ScalingOptions& options, const World& world);

struct LoadSeen {
  struct Region {
    double frame_ms = 0;  // p99 over about the last second
    int64_t awake = 0;
  };
  std::chrono::steady_clock::time_point time;
  // All regions run and are heard of; no change is under way.
  bool steady = false;
  Tick tick = 0;                // of the world; looks without a new one say nothing new
  std::vector<Region> regions;  // those that have an area
};

struct Scaling {
  int from = 0, to = 0;
  std::string why;  // in numbers

  // "scaled from 2 to 6 regions: p99 of the busiest region 14.1 ms of 16.7 ms for 5 s".
  std::string Text() const;
};

// One thread at a time.
class Autoscaler {
 public:
  // Precondition: CheckScaling(options).ok() and options.on().
  Autoscaler(const ScalingOptions& options, int64_t tick_us);

  const ScalingOptions& options() const { return options_; }

  // The wanted number of regions, when it is another one. To be called some times a second. Who gets one begins the
  // change, or gets it again after `up_after` or more.
  std::optional<Scaling> Look(const LoadSeen& seen);

 private:
  using Time = std::chrono::steady_clock::time_point;
  using Duration = std::chrono::steady_clock::duration;
  // Of the busiest region; by its share.
  struct Load {
    double share = 0;
    double frame_ms = 0;
    int64_t awake = 0;
  };
  struct Sample {
    Time time;
    Load busiest;
    double sum = 0;  // of the shares of all regions
    Load lasting;    // the least of the busiest for up_after; nothing where that is not known
  };

  double ByFrame(const LoadSeen::Region& region) const;
  double ByBodies(const LoadSeen::Region& region) const;
  Sample Measure(const LoadSeen& seen) const;
  void BeginAnew(const LoadSeen& seen);
  std::optional<Scaling> More(const LoadSeen& seen);
  std::optional<Scaling> Fewer(const LoadSeen& seen) const;
  std::string Words(const Load& load, const char* most, Duration time) const;

  const ScalingOptions options_;
  const double tick_ms_;
  size_t regions_ = 0;  // as seen last
  Time steady_since_;
  Tick tick_ = 0;
  std::deque<Sample> samples_;  // since then, of at least down_after, one a second or more
  Duration down_after_;
  std::optional<Time> fewer_at_;  // when there were fewer last
};

}  // namespace aureole
