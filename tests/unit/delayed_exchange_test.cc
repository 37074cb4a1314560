// What the fixed-delay exchange (k >= 1) tells and decides, in small worlds.
#include <array>
#include <limits>

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

INSTANTIATE_TEST_SUITE_P(EveryDelay, DelayedExchange, testing::Values(1, 2, 3),
                         [](const auto& param) { return "k" + std::to_string(param.param); });

}  // namespace
}  // namespace aureole
