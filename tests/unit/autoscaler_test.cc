// When a world is scaled, and that it comes to rest: by tables, and by hours of simulated load.
#include "server/control/autoscaler.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <random>

#include <absl/strings/match.h>

#include "server/core/partition.h"

namespace aureole {
namespace {

using std::chrono::duration_cast;
using std::chrono::hours;
using std::chrono::milliseconds;
using std::chrono::minutes;
using std::chrono::seconds;
using Time = std::chrono::steady_clock::time_point;

constexpr int64_t kTickUs = 16'000;

ScalingOptions Between(int min, int max) {
  ScalingOptions out;
  out.min_regions = min;
  out.max_regions = max;
  return out;
}

// A world that begins a change when it is told to, and is still for `change` until it is done.
class Cluster {
 public:
  // What each region has, of so many, at that time.
  using Load = std::function<std::vector<LoadSeen::Region>(milliseconds time, int regions)>;

  Cluster(const ScalingOptions& options, int regions, Load load)
      : autoscaler_(options, kTickUs), regions_(regions), load_(std::move(load)) {}

  void Run(milliseconds time, milliseconds change = seconds(2)) {
    for (const milliseconds end = now_ + time; now_ < end; now_ += every) {
      const bool steady = now_ >= still_until_ && !(blocked && blocked(now_));
      const std::optional<Scaling> scaling = autoscaler_.Look({Time(now_), steady, Ticks(), load_(now_, regions_)});
      if (!scaling.has_value()) continue;
      EXPECT_TRUE(steady);
      EXPECT_EQ(scaling->from, regions_);
      EXPECT_NE(scaling->to, regions_);
      EXPECT_GE(scaling->to, autoscaler_.options().min_regions);
      EXPECT_LE(scaling->to, autoscaler_.options().max_regions);
      changes.push_back({now_, scaling->to, scaling->Text()});
      regions_ = scaling->to;
      still_until_ = now_ + change;
    }
  }
  int regions() const { return regions_; }
  Tick Ticks() const { return stands_still ? 1 : 1 + now_ / milliseconds(16); }

  struct Change {
    milliseconds at;
    int to;
    std::string text;
  };
  std::vector<Change> changes;
  std::function<bool(milliseconds)> blocked;
  bool stands_still = false;
  milliseconds every{100};  // between looks

 private:
  Autoscaler autoscaler_;
  int regions_;
  const Load load_;
  milliseconds now_{0}, still_until_{0};
};

// So much frame time in all, evenly divided.
Cluster::Load Frames(std::function<double(milliseconds)> total_ms) {
  return [total_ms](milliseconds time, int regions) {
    return std::vector<LoadSeen::Region>(static_cast<size_t>(regions), {total_ms(time) / regions, 0});
  };
}
Cluster::Load Frames(double total_ms) {
  return Frames([total_ms](milliseconds) { return total_ms; });
}
Cluster::Load Awake(int64_t total) {
  return [total](milliseconds, int regions) {
    return std::vector<LoadSeen::Region>(static_cast<size_t>(regions), {0, total / regions});
  };
}

std::vector<int> Sizes(const Cluster& cluster) {
  std::vector<int> out;
  for (const Cluster::Change& c : cluster.changes) out.push_back(c.to);
  return out;
}

TEST(Autoscaler, SteadyLoadGetsTheRegionsItNeedsAtOnceAndNoOthers) {
  // 70 % of 16 ms are 11.2 ms, and 7.8 ms is what each is to have.
  const struct {
    int min, max, from;
    double total_ms;
    std::vector<int> then;
  } cases[] = {
      {1, 8, 2, 10, {}},                         // 5 ms each
      {1, 8, 2, 22, {}},                         // 11 ms each
      {1, 8, 2, 23, {3}},                        // one more is enough
      {1, 8, 2, 45, {6}},                        // proportional to the load
      {1, 8, 2, 1000, {8}},                      // not above max
      {1, 8, 8, 1000, {}},                       // nor beyond
      {1, 8, 8, 0, {1}},                         // idle
      {3, 8, 8, 0, {3}},                         // not below min
      {1, 8, 8, 20, {4}},                        // 5 ms each then
      {1, 8, 2, 8, {}},                          // one would have 8 ms: too near to 11.2
      {1, 8, 2, 5, {1}},     {4, 8, 2, 5, {4}},  // min was raised
      {1, 3, 7, 100, {3}},                       // max was lowered
      {2, 64, 2, 1e9, {64}}, {3, 3, 2, 4, {3}},  // a number of its own
  };
  for (const auto& c : cases) {
    Cluster cluster(Between(c.min, c.max), c.from, Frames(c.total_ms));
    cluster.Run(minutes(30));
    EXPECT_EQ(Sizes(cluster), c.then) << c.from << " regions, " << c.total_ms << " ms";
  }
}

TEST(Autoscaler, BodiesAwakeCountWhereTheyAreBounded) {
  ScalingOptions options = Between(1, 8);
  for (const auto& [bound, total, then] : std::vector<std::tuple<int64_t, int64_t, std::vector<int>>>{
           {0, 100000, {}}, {100, 400, {6}}, {100, 200, {}}, {1000, 200, {1}}, {100, 0, {1}}}) {
    options.awake_bodies = bound;
    // A frame time that is neither high nor low.
    Cluster cluster(options, 2, [&, total = total](milliseconds, int regions) {
      return std::vector<LoadSeen::Region>(static_cast<size_t>(regions), {bound == 0 ? 4.0 : 0, total / regions});
    });
    cluster.Run(minutes(10));
    EXPECT_EQ(Sizes(cluster), then) << total << " of " << bound;
  }
}

TEST(Autoscaler, DecisionsSayWhyInNumbers) {
  Cluster frames(Between(1, 8), 2, Frames(28.2));
  frames.Run(minutes(1));
  ASSERT_EQ(frames.changes.size(), 1u);
  EXPECT_EQ(frames.changes[0].text, "scaled from 2 to 4 regions: p99 of the busiest region 14.1 ms of 16.0 ms for 5 s");
  ScalingOptions options = Between(1, 8);
  options.awake_bodies = 100;
  Cluster bodies(options, 2, Awake(400));
  bodies.Run(minutes(1));
  ASSERT_EQ(bodies.changes.size(), 1u);
  EXPECT_EQ(bodies.changes[0].text,
            "scaled from 2 to 6 regions: 200 bodies awake of 100 in the busiest region for 5 s");
  Cluster idle(Between(1, 8), 4, Frames(4));
  idle.Run(minutes(2));
  ASSERT_EQ(idle.changes.size(), 1u);
  EXPECT_EQ(idle.changes[0].text,
            "scaled from 4 to 1 regions: p99 of the busiest region at most 1.0 ms of 16.0 ms for 60 s");
  Cluster bounds(Between(3, 8), 2, Frames(4));
  bounds.Run(seconds(1));
  ASSERT_EQ(bounds.changes.size(), 1u);
  EXPECT_EQ(bounds.changes[0].text, "scaled from 2 to 3 regions: there must be 3 to 8");
}

TEST(Autoscaler, TimesAreKept) {
  ScalingOptions options = Between(1, 8);
  Cluster more(options, 2, Frames(1e9));
  more.Run(minutes(1));
  ASSERT_FALSE(more.changes.empty());
  // It looks for up_after, after as long for the world to come to rest.
  EXPECT_GE(more.changes[0].at, 2 * options.up_after);
  EXPECT_LE(more.changes[0].at, 2 * options.up_after + seconds(1));
  Cluster fewer(options, 8, Frames(0));
  fewer.Run(minutes(2));
  ASSERT_FALSE(fewer.changes.empty());
  EXPECT_GE(fewer.changes[0].at, options.up_after + options.down_after);
  EXPECT_LE(fewer.changes[0].at, options.up_after + options.down_after + seconds(1));
  options.up_after = milliseconds(200);
  options.down_after = milliseconds(1000);
  Cluster fast(options, 8, Frames(0));
  fast.Run(seconds(2));
  EXPECT_EQ(Sizes(fast), std::vector<int>{1});
}

TEST(Autoscaler, SpikesDoNothing) {
  // A second of ten times the load, every 20 s: too short for more regions; and what is low stays low.
  for (const auto& [base, then] : std::vector<std::pair<double, std::vector<int>>>{{12, {}}, {2, {1}}}) {
    Cluster cluster(Between(1, 8), 2, Frames([base = base](milliseconds time) {
                      return time % seconds(20) < seconds(2) ? base * 10 : base;  // p99 shows it for another second
                    }));
    cluster.Run(hours(2));
    EXPECT_EQ(Sizes(cluster), then) << base;
  }
}

TEST(Autoscaler, DipsOfASecondDoNotEndAnOverload) {
  Cluster cluster(Between(1, 8), 2, Frames([](milliseconds time) { return time % seconds(60) < seconds(1) ? 0 : 60; }));
  cluster.Run(hours(1));
  EXPECT_EQ(Sizes(cluster), std::vector<int>{8});
}

TEST(Autoscaler, NothingIsDecidedWhileTheWorldIsNotSteady) {
  Cluster cluster(Between(1, 8), 2, Frames(1e9));
  cluster.blocked = [](milliseconds time) { return time < minutes(10) || time % seconds(8) < milliseconds(100); };
  cluster.Run(minutes(20));
  EXPECT_TRUE(cluster.changes.empty()) << "a server is replaced every 8 s";
  cluster.blocked = nullptr;
  cluster.Run(minutes(1));
  EXPECT_EQ(Sizes(cluster), std::vector<int>{8});
}

TEST(Autoscaler, AWorldThatStandsStillSaysNothing) {
  Cluster cluster(Between(1, 8), 4, Frames(0));
  cluster.stands_still = true;
  cluster.Run(hours(1));
  EXPECT_TRUE(cluster.changes.empty());
  cluster.stands_still = false;
  cluster.Run(minutes(2));
  EXPECT_EQ(Sizes(cluster), std::vector<int>{1});
}

TEST(Autoscaler, AWorldOfIdleBodiesNeverFlaps) {
  std::mt19937 random(1);
  std::exponential_distribution<double> noise(1 / 0.4);  // ms; of a machine that does other things too
  for (int from : {1, 2, 5, 8}) {
    Cluster cluster(Between(1, 8), from, [&](milliseconds, int regions) {
      std::vector<LoadSeen::Region> out;
      for (int r = 0; r < regions; ++r) out.push_back({0.3 + noise(random), 0});
      return out;
    });
    cluster.every = seconds(1);
    cluster.Run(hours(24));
    EXPECT_LE(cluster.changes.size(), 2u) << from << ": fewer, and then as few as there may be";
    EXPECT_EQ(cluster.regions(), 1);
  }
}

// Bodies are around a place that may be anywhere; regions are columns of equal width; frames cost time by themselves,
// by their bodies, and by chance.
class Crowd {
 public:
  explicit Crowd(unsigned seed) : random_(seed) {}

  std::vector<LoadSeen::Region> operator()(double bodies, double place, double spread, int regions) {
    std::vector<LoadSeen::Region> out;
    const auto below = [&](double x) { return 0.5 * std::erfc((place - x) / spread); };
    std::lognormal_distribution<double> noise(0, 0.15);
    for (int r = 0; r < regions; ++r) {
      const double low = r == 0 ? -1e9 : static_cast<double>(r) / regions;
      const double high = r == regions - 1 ? 1e9 : static_cast<double>(r + 1) / regions;
      const double own = bodies * (below(high) - below(low));
      const double late = std::uniform_real_distribution<double>(0, 1)(random_) < 0.002 ? 15 : 0;
      out.push_back({(0.4 + own * 5e-3) * noise(random_) + late, static_cast<int64_t>(own)});
    }
    return out;
  }

 private:
  std::mt19937 random_;
};

TEST(Autoscaler, NoisyLoadComesToRestBetweenItsBounds) {
  for (unsigned seed = 1; seed <= 20; ++seed) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> any(0, 1);
    const double bodies = 200 + 12000 * any(random), place = any(random), spread = 0.05 + any(random);
    const int from = 1 + static_cast<int>(random() % 12);
    Crowd crowd(seed);
    Cluster cluster(Between(1, 12), from,
                    [&](milliseconds, int regions) { return crowd(bodies, place, spread, regions); });
    cluster.every = seconds(1);
    cluster.Run(hours(1));
    // Whatever it tried at first.
    const size_t tried = cluster.changes.size();
    EXPECT_LE(tried, 12u) << "seed " << seed;
    cluster.Run(hours(4));
    EXPECT_LE(cluster.changes.size(), tried + 2) << "seed " << seed << ", " << bodies << " bodies around " << place;
    const std::vector<LoadSeen::Region> end = crowd(bodies, place, spread, cluster.regions());
    double busiest = 0;
    for (const LoadSeen::Region& r : end) busiest = std::max(busiest, 0.4 + static_cast<double>(r.awake) * 5e-3);
    if (cluster.regions() < 12) {
      EXPECT_LT(busiest, 11.2 * 1.2) << "seed " << seed;
    }
  }
}

TEST(Autoscaler, FollowsADay) {
  Crowd crowd(3);
  const auto bodies = [](milliseconds time) {
    return 4000 + 3900 * std::sin(2 * M_PI * duration_cast<seconds>(time).count() / (24 * 3600.0));
  };
  Cluster cluster(Between(1, 12), 1,
                  [&](milliseconds time, int regions) { return crowd(bodies(time), 0.5, 1.0, regions); });
  cluster.every = seconds(1);
  int most = 0, least = 100;
  for (int hour = 0; hour < 48; ++hour) {
    cluster.Run(hours(1));
    most = std::max(most, cluster.regions());
    if (hour > 12) least = std::min(least, cluster.regions());
  }
  EXPECT_GE(most, 4);
  EXPECT_EQ(least, 1);
  EXPECT_LE(cluster.changes.size(), 2u * 2 * 12) << "all the way up and down, each day";
  // Never one way and soon the other.
  for (size_t i = 2; i < cluster.changes.size(); ++i) {
    const bool up = cluster.changes[i].to > cluster.changes[i - 1].to;
    const bool up_before = cluster.changes[i - 1].to > cluster.changes[i - 2].to;
    if (up != up_before) {
      EXPECT_GT(cluster.changes[i].at - cluster.changes[i - 1].at, seconds(60)) << cluster.changes[i].text;
    }
  }
}

TEST(Autoscaler, FewerThatWereTooFewAreTriedEverMoreSeldom) {
  // All bodies come together as soon as there are three regions or fewer.
  Cluster cluster(Between(1, 8), 4, [](milliseconds, int regions) {
    std::vector<LoadSeen::Region> out(static_cast<size_t>(regions), {1, 0});
    if (regions < 4) out[0].frame_ms = 15;
    return out;
  });
  cluster.every = seconds(1);
  cluster.Run(hours(5));
  // At once, then after 1, 2, 4, ... 32 minutes: two changes each, or three.
  EXPECT_LE(cluster.changes.size(), 45u);
  Cluster plain(Between(1, 8), 4, Frames(4));
  plain.every = seconds(1);
  plain.Run(hours(5));
  EXPECT_EQ(plain.changes.size(), 1u);
}

TEST(Autoscaler, ValuesOutOfRangeAreRefusedWithTheField) {
  const auto message = [](const std::function<void(ScalingOptions*)>& change) {
    ScalingOptions options = Between(1, 4);
    change(&options);
    const absl::Status s = CheckScaling(options);
    EXPECT_TRUE(s.ok() || absl::IsInvalidArgument(s)) << s;
    return std::string(s.message());
  };
  EXPECT_EQ(message([](ScalingOptions*) {}), "");
  EXPECT_EQ(message([](ScalingOptions* o) { o->min_regions = 4; }), "");
  EXPECT_EQ(message([](ScalingOptions* o) { o->min_regions = 0; }), "min: is 0; must be 1 to 64 regions");
  EXPECT_EQ(message([](ScalingOptions* o) { o->max_regions = 65; }), "max: is 65; must be 1 to 64 regions");
  EXPECT_EQ(message([](ScalingOptions* o) { o->min_regions = 5; }), "min: is 5, above max 4; exchange them");
  EXPECT_EQ(message([](ScalingOptions* o) { o->frame_percent = 0; }),
            "framePercent: is 0; must be 1 to 1000 percent of the tick");
  EXPECT_TRUE(absl::StartsWith(message([](ScalingOptions* o) { o->awake_bodies = -1; }), "awakeBodies: is -1; must"));
  EXPECT_TRUE(absl::StartsWith(message([](ScalingOptions* o) { o->up_after = milliseconds(1); }), "upAfter: must be"));
  EXPECT_TRUE(absl::StartsWith(message([](ScalingOptions* o) { o->up_after = hours(25); }), "upAfter: must be"));
  EXPECT_TRUE(absl::StartsWith(message([](ScalingOptions* o) { o->down_after = seconds(4); }), "downAfter: must be"));
}

TEST(Autoscaler, AWorldWithADelayIsNotScaled) {
  World world(*Layout::Columns({}));
  EXPECT_TRUE(CheckScales(Between(1, 4), world).ok());
  world.exchange.k = 1;
  EXPECT_TRUE(CheckScales(Between(1, 1), world).ok());
  EXPECT_FALSE(CheckScales(Between(4, 4), world).ok());
  const absl::Status s = CheckScales(Between(1, 4), world);
  EXPECT_TRUE(absl::IsFailedPrecondition(s)) << s;
  EXPECT_TRUE(absl::StrContains(s.message(), "set exchange.delay to 0")) << s;
}

}  // namespace
}  // namespace aureole
