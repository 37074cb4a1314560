#include <array>
#include <memory>

#include <gtest/gtest.h>

#include "tests/simulation/lockstep.h"

namespace aureole {
namespace {

BodySpec Ball(BodyId id, double x, double vx, double mass) {
  auto shape = std::make_shared<Shape>();
  shape->radius = 0.3;
  BodySpec b;
  b.id = id;
  b.shape = shape;
  b.mass = mass;
  b.position = {x, 0, 0};
  b.velocity = {vx, 0, 0};
  return b;
}

World TwoColumns(int k) {
  World w(*Layout::Columns(std::array{0.0}));
  w.environment.gravity = Vec3::Zero();
  w.exchange.k = k;
  return w;
}

int64_t Crossings(sim::Lockstep& s) { return s.region(0).stats().home_crossings + s.region(1).stats().home_crossings; }

TEST(HomeCrossings, BodyThatBeganAwayFromHomeHasNotCrossed) {
  World w = TwoColumns(1);
  w.bodies = {Ball(1, -0.5, 0, 100), Ball(2, 0.5, 0, 1)};
  sim::Lockstep s(w);
  s.RunTo(20);
  ASSERT_EQ(s.Owner(2), 0) << "near the heavy one";
  ASSERT_EQ(s.region(0).stats().away_bodies, 1);
  EXPECT_EQ(Crossings(s), 0);
}

TEST(HomeCrossings, EachIsCountedOnceUnderEveryDelay) {
  for (const int k : {0, 1, 2, 3}) {
    World w = TwoColumns(k);
    w.bodies = {Ball(1, -3, 4, 1), Ball(2, 40, 0, 1)};
    sim::Lockstep s(w);
    s.RunTo(100);
    EXPECT_EQ(Crossings(s), 1) << "k = " << k;
  }
}

}  // namespace
}  // namespace aureole
