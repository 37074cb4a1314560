// What the fixed-delay exchange (k >= 1) tells and decides, in small worlds.
#include <algorithm>
#include <array>
#include <limits>
#include <numeric>

#include <gtest/gtest.h>

#include "tests/simulation/lockstep.h"

namespace aureole {
namespace {

using sim::Lockstep;
using sim::Undivided;

constexpr double kInf = std::numeric_limits<double>::infinity();
constexpr double kRadius = 0.3;

BodySpec Ball(BodyId id, const Vec3& position, double vx = 0) {
  auto shape = std::make_shared<Shape>();
  shape->radius = kRadius;
  BodySpec b;
  b.id = id;
  b.shape = shape;
  b.position = position;
  b.velocity = {vx, 0, 0};
  return b;
}

World WeightlessWorld(Layout layout, int k) {
  World w(std::move(layout));
  w.environment.gravity = Vec3::Zero();
  w.environment.speed_limit = w.tolerances.speed;
  w.exchange.k = k;
  w.exchange.recovery = 0;
  return w;
}

class DelayedExchange : public testing::TestWithParam<int> {};

// R1, R2: whoever has it, the aura of state n is exactly that of the undivided world, once, from the owner or, while it
// is in flight, from its sender.
TEST_P(DelayedExchange, BodyInFlightIsShownToThirdRegionsWhereItIs) {
  // From region 0 into region 1, along region 2.
  World w = WeightlessWorld(*Layout::Rectangles({{-kInf, 0, 0, kInf}, {0, kInf, 0, kInf}, {-kInf, kInf, -kInf, 0}}),
                            GetParam());
  w.bodies = {Ball(1, {-8, 0, 1}, 10)};
  Lockstep split(w);
  Undivided whole(split.world());
  Tick in_flight = 0;
  for (Tick n = 1; n <= 250; ++n) {
    split.RunTo(n);
    whole.RunTo(n);
    const Vec3 centre = whole.engine().View(1).centre;
    const WireBox box = RoundOutward({centre.array() - kRadius, centre.array() + kRadius});
    int told = 0;
    for (const Frame& f : split.LastFrames()) {
      for (const Aura& a : f.auras) {
        if (f.to != std::vector<RegionId>{2}) continue;
        ++told;
        EXPECT_TRUE(a.box == box) << "tick " << n << " from region " << f.from;
      }
    }
    EXPECT_EQ(told, 1) << "tick " << n;
    in_flight += split.Owner(1) == kNoRegion;
  }
  EXPECT_EQ(split.Owner(1), 1);
  EXPECT_EQ(in_flight, GetParam());
}

// R10: a sleeper does not move, but it may be struck in the tick in which it is reached.
TEST_P(DelayedExchange, SleeperIsCoHostedBeforeAFastBodyReachesIt) {
  for (int i = 0; i < 20; ++i) {
    World w = WeightlessWorld(*Layout::Columns(std::array{0.0}), GetParam());
    w.bodies = {Ball(1, {-20 + 0.05 * i, 0, 0}, 31.9), Ball(2, {1, 0, 0})};
    w.bodies[1].asleep = true;
    Lockstep split(w);
    ASSERT_EQ(split.Owner(2), 1);
    Undivided whole(split.world());
    for (Tick n = 1; n <= 60; ++n) {
      split.RunTo(n);
      whole.RunTo(n);
      ASSERT_EQ(split.Hash(), whole.Hash()) << "tick " << n << ", start " << i;
    }
    EXPECT_FALSE(whole.engine().View(2).asleep) << "it must have been struck";
  }
}

// Two that run into each other are together some ticks before; that is the slack.
TEST_P(DelayedExchange, SlackIsTheTimeFromArrivalToFirstTouch) {
  World w = WeightlessWorld(*Layout::Columns(std::array{0.0}), GetParam());
  w.bodies = {Ball(1, {-0.5, 0, 0}), Ball(2, {20, 0, 0}, -20), Ball(3, {-0.5, 0, 50}), Ball(4, {20, 0, 50}, -15)};
  Lockstep split(w);
  Undivided whole(split.world());
  std::array<Tick, 2> arrived{}, touched{};
  for (Tick n = 1; n <= 140; ++n) {
    split.RunTo(n);
    whole.RunTo(n);
    ASSERT_EQ(split.Hash(), whole.Hash());
    for (size_t i = 0; i < 2; ++i) {
      const BodyId mover = 2 * i + 2;
      if (arrived[i] == 0 && split.Owner(mover) == 0) arrived[i] = n;
      if (touched[i] == 0 && whole.engine().View(mover).velocity.x() > -14) touched[i] = n;
    }
  }
  const auto& slack = split.region(0).stats().slack;
  EXPECT_EQ(std::accumulate(slack.begin(), slack.end(), int64_t{0}), 2);
  for (size_t i = 0; i < 2; ++i) {
    ASSERT_GT(arrived[i], 0);
    ASSERT_GT(touched[i], arrived[i]);
    EXPECT_GT(slack[static_cast<size_t>(std::min(kSlackTicks, touched[i] - arrived[i]))], 0);
  }
}

// R11: what acts on a body in flight was heard before it was sent. Here something acts in every tick.
TEST_P(DelayedExchange, InputsOfClientsActInFlightToo) {
  World w = WeightlessWorld(*Layout::Columns(std::array{0.0}), GetParam());
  w.bodies = {Ball(1, {-6, 0, 0}, 10)};
  Lockstep split(w);
  Undivided whole(split.world());
  int64_t changes = 0;
  RegionId before = 0;
  for (Tick n = 1; n <= 200; ++n) {
    Input kick;
    kick.kind = Input::Kind::kVelocity;
    kick.source = 1;
    kick.sequence = static_cast<uint64_t>(n);
    kick.body = 1;
    kick.linear = {n % 100 < 50 ? 10.0 : -10.0, 0, 0.01 * static_cast<double>(n)};
    ASSERT_TRUE(split.region(n % 2 == 0 ? 0 : 1).Submit(kick).ok());
    split.RunTo(n);
    for (const Input& i : split.region(0).TakeDelivered()) whole.Add(i);
    whole.RunTo(n);
    ASSERT_EQ(split.Hash(), whole.Hash()) << "tick " << n;
    const RegionId owner = split.Owner(1);
    changes += owner != kNoRegion && owner != before;
    if (owner != kNoRegion) before = owner;
  }
  EXPECT_GE(changes, 2);
}

// Joules that region `from` told region `to` of the body in the last tick; negative when it said nothing new of it.
double EnergyTold(const Lockstep& split, RegionId from, RegionId to, BodyId id) {
  for (const Frame& f : split.LastFrames()) {
    if (f.from != from || f.to != std::vector<RegionId>{to}) continue;
    for (const Aura& a : f.auras) {
      if (a.id == id) return a.energy;
    }
  }
  return -1;
}

double KineticEnergy(Lockstep& split, BodyId id) {
  const BodyView v = split.region(split.Owner(id)).engine().View(id);
  return 0.5 * v.mass * v.velocity.squaredNorm();
}

// R12: what a region was told by another does not come back to that other, or it would double in every exchange.
TEST_P(DelayedExchange, ReachTellsNobodyHisOwnEnergy) {
  World w = WeightlessWorld(*Layout::Columns(std::array{0.0}), GetParam());
  w.exchange.policy = AuraPolicy::kReach;
  // Along the border, drawing nearer.
  w.bodies = {Ball(1, {-7, 0, 0}, 3), Ball(2, {7, 0, 0}, -3)};
  w.bodies[0].velocity.z() = w.bodies[1].velocity.z() = 9.5;
  Lockstep split(w);
  ASSERT_NE(split.Owner(1), split.Owner(2));
  const double energy = KineticEnergy(split, 1);
  ASSERT_EQ(energy, KineticEnergy(split, 2));
  Tick n = 1;
  for (; n <= 160 && split.Owner(1) == 0 && split.Owner(2) == 1; ++n) {
    EXPECT_LE(EnergyTold(split, 0, 1, 1), 1.001 * energy) << "tick " << n;
    EXPECT_LE(EnergyTold(split, 1, 0, 2), 1.001 * energy) << "tick " << n;
    split.RunTo(n);
  }
  EXPECT_LE(n, 160) << "they must have come within reach";
}

// R12: a region that sees only the near end of a row is told what may strike its far end.
TEST_P(DelayedExchange, ReachTellsOfTheEnergyOfThirdRegions) {
  World w = WeightlessWorld(*Layout::Columns(std::array{0.0, 3.0}), GetParam());
  w.exchange.policy = AuraPolicy::kReach;
  for (BodyId id = 1; id <= 4; ++id) {
    w.bodies.push_back(Ball(id, {0.5 + 0.59 * static_cast<double>(id - 1), 0, 0}));
    w.bodies.back().asleep = true;
  }
  w.bodies.push_back(Ball(5, {25, 0, 0}, -20));
  Lockstep split(w);
  ASSERT_EQ(split.Owner(1), 1);
  ASSERT_EQ(split.Owner(5), 2);
  const double energy = KineticEnergy(split, 5);
  double told = 0;
  for (Tick n = 1; n <= 100 && split.Owner(5) == 2; ++n) {
    split.RunTo(n);
    told = std::max(told, EnergyTold(split, 1, 0, 1));
  }
  EXPECT_EQ(split.Owner(1), 1);
  EXPECT_GE(told, energy);
}

INSTANTIATE_TEST_SUITE_P(EveryDelay, DelayedExchange, testing::Values(1, 2, 3),
                         [](const auto& param) { return "k" + std::to_string(param.param); });

}  // namespace
}  // namespace aureole
