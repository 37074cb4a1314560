#include "server/control/autoscaler.h"

#include <algorithm>
#include <cmath>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>

#include "server/core/limits.h"

namespace aureole {
namespace {

using std::chrono::milliseconds;

constexpr double kAim = 0.7;       // share of each region after there are more
constexpr double kCalm = 0.5;      // of the busiest after there are fewer, at most
constexpr int kMostPatience = 32;  // times down_after
constexpr milliseconds kLeastTime{100}, kMostTime{24 * 3600 * 1000};
constexpr int kMostPercent = 1000;
constexpr milliseconds kSampleEvery{1000};
constexpr int kSamples = 5;  // in up_after, at least

absl::Status Refuse(const char* field, const std::string& what) {
  return absl::InvalidArgumentError(absl::StrCat(field, ": ", what));
}

std::string Seconds(std::chrono::steady_clock::duration d) {
  return absl::StrFormat("%.3g s", std::chrono::duration<double>(d).count());
}

}  // namespace

absl::Status CheckScaling(const ScalingOptions& o) {
  constexpr int kMost = limits::kMaxRegions;
  if (o.min_regions < 1 || o.min_regions > kMost) {
    return Refuse("min", absl::StrCat("is ", o.min_regions, "; must be 1 to ", kMost, " regions"));
  }
  if (o.max_regions < 1 || o.max_regions > kMost) {
    return Refuse("max", absl::StrCat("is ", o.max_regions, "; must be 1 to ", kMost, " regions"));
  }
  if (o.min_regions > o.max_regions) {
    return Refuse("min", absl::StrCat("is ", o.min_regions, ", above max ", o.max_regions, "; exchange them"));
  }
  if (o.frame_percent < 1 || o.frame_percent > kMostPercent) {
    return Refuse("framePercent",
                  absl::StrCat("is ", o.frame_percent, "; must be 1 to ", kMostPercent, " percent of the tick"));
  }
  if (o.awake_bodies < 0 || o.awake_bodies > limits::kMaxBodies) {
    return Refuse("awakeBodies", absl::StrCat("is ", o.awake_bodies, "; must be 1 to ", limits::kMaxBodies,
                                              " bodies of a region, or 0 for any number"));
  }
  if (o.up_after < kLeastTime || o.up_after > kMostTime) {
    return Refuse("upAfter", "must be a time of 100ms to 24h, such as \"5s\"");
  }
  if (o.down_after < o.up_after || o.down_after > kMostTime) {
    return Refuse("downAfter", "must be a time from upAfter to 24h, such as \"60s\"");
  }
  return absl::OkStatus();
}

absl::Status CheckScales(const ScalingOptions& options, const World& world) {
  const bool stays = options.min_regions == options.max_regions && options.max_regions == world.layout.size();
  if (!options.on() || stays || world.exchange.k == 0) return absl::OkStatus();
  return absl::FailedPreconditionError(absl::StrCat(
      "from ", options.min_regions, " to ", options.max_regions,
      " needs a layout that can change while the world runs, and the exchange of this one has a delay; set "
      "exchange.delay to 0, or leave the number of regions as in its layout"));
}

std::string Scaling::Text() const { return absl::StrCat("scaled from ", from, " to ", to, " regions: ", why); }

Autoscaler::Autoscaler(const ScalingOptions& options, int64_t tick_us)
    : options_(options), tick_ms_(static_cast<double>(tick_us) * 1e-3), down_after_(options.down_after) {}

double Autoscaler::ByFrame(const LoadSeen::Region& region) const {
  return region.frame_ms / (tick_ms_ * options_.frame_percent / 100);
}

double Autoscaler::ByBodies(const LoadSeen::Region& region) const {
  if (options_.awake_bodies == 0) return 0;
  return static_cast<double>(region.awake) / static_cast<double>(options_.awake_bodies);
}

Autoscaler::Sample Autoscaler::Measure(const LoadSeen& seen) const {
  Sample out;
  out.time = seen.time;
  for (const LoadSeen::Region& region : seen.regions) {
    const double share = std::max(ByFrame(region), ByBodies(region));
    out.sum += share;
    if (share >= out.busiest.share) out.busiest = {share, region.frame_ms, region.awake};
  }
  return out;
}

void Autoscaler::BeginAnew(const LoadSeen& seen) {
  regions_ = seen.regions.size();
  steady_since_ = seen.time;
  samples_.clear();
}

std::optional<Scaling> Autoscaler::Look(const LoadSeen& seen) {
  if (!seen.steady || seen.regions.empty()) {
    BeginAnew(seen);
    return std::nullopt;
  }
  const int now = static_cast<int>(seen.regions.size());
  if (const int allowed = std::clamp(now, options_.min_regions, options_.max_regions); allowed != now) {
    // At once, and again when nothing has come of it.
    if (regions_ == seen.regions.size() && seen.time - steady_since_ < options_.up_after) return std::nullopt;
    BeginAnew(seen);
    return Scaling{now, allowed, absl::StrCat("there must be ", options_.min_regions, " to ", options_.max_regions)};
  }
  const bool gap = !samples_.empty() && seen.time - samples_.back().time > options_.up_after + kSampleEvery;
  if (regions_ != seen.regions.size() || gap) BeginAnew(seen);
  const Duration every = std::min<Duration>(kSampleEvery, options_.up_after / kSamples);
  if (seen.time - steady_since_ < options_.up_after || seen.tick <= tick_ ||
      (!samples_.empty() && seen.time - samples_.back().time < every)) {
    return std::nullopt;
  }
  tick_ = seen.tick;
  samples_.push_back(Measure(seen));
  // One that is as old stays, so that what is kept covers the time.
  while (samples_.size() > 1 && seen.time - samples_[1].time >= down_after_) samples_.pop_front();

  std::optional<Scaling> out = More(seen);
  if (!out.has_value()) out = Fewer(seen);
  if (!out.has_value()) return std::nullopt;
  if (out->to < out->from) {
    fewer_at_ = seen.time;
  } else {
    const bool too_few = fewer_at_.has_value() && seen.time - *fewer_at_ < down_after_;
    down_after_ = too_few ? std::min<Duration>(down_after_ * 2, options_.down_after * kMostPatience)
                          : Duration(options_.down_after);
  }
  BeginAnew(seen);
  return out;
}

// Of the time since `up_after` ago.
std::optional<Scaling> Autoscaler::More(const LoadSeen& seen) {
  if (seen.time - samples_.front().time < options_.up_after) return std::nullopt;
  Sample least = samples_.back();
  for (auto sample = samples_.rbegin(); sample != samples_.rend(); ++sample) {
    if (sample->busiest.share < least.busiest.share) least.busiest = sample->busiest;
    least.sum = std::min(least.sum, sample->sum);
    if (seen.time - sample->time >= options_.up_after) break;
  }
  samples_.back().lasting = least.busiest;
  const int now = static_cast<int>(seen.regions.size());
  if (least.busiest.share <= 1 || now == options_.max_regions) return std::nullopt;
  const int wanted = std::max(now + 1, static_cast<int>(std::ceil(std::min(least.sum / kAim, 1e6))));
  return Scaling{now, std::min(wanted, options_.max_regions), Words(least.busiest, "", options_.up_after)};
}

// If the load of the busiest grows as the others become fewer.
std::optional<Scaling> Autoscaler::Fewer(const LoadSeen& seen) const {
  if (seen.time - samples_.front().time < down_after_) return std::nullopt;
  Load most;
  for (const Sample& sample : samples_) {
    if (sample.lasting.share >= most.share) most = sample.lasting;
  }
  const int now = static_cast<int>(seen.regions.size());
  const double wanted = std::ceil(most.share * now / kCalm);
  if (wanted >= now || now == options_.min_regions) return std::nullopt;
  const int to = std::max({1, options_.min_regions, static_cast<int>(wanted)});
  return Scaling{now, to, Words(most, "at most ", down_after_)};
}

std::string Autoscaler::Words(const Load& load, const char* most, Duration time) const {
  const LoadSeen::Region region{load.frame_ms, load.awake};
  const std::string what =
      ByFrame(region) >= ByBodies(region)
          ? absl::StrFormat("p99 of the busiest region %s%.1f ms of %.1f ms", most, load.frame_ms, tick_ms_)
          : absl::StrFormat("%s%d bodies awake of %d in the busiest region", most, load.awake, options_.awake_bodies);
  return absl::StrCat(what, " for ", Seconds(time));
}

}  // namespace aureole
