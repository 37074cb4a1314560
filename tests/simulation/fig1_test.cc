// The situations of the paper's Fig. 1, from its prose (sections 3.1 to 3.6), named after the letters. Server 0 lies
// left of server 1; server 2 lies under both.
#include <limits>

#include <gtest/gtest.h>

#include "tests/simulation/lockstep.h"

namespace aureole::sim {
namespace {

constexpr double kInf = std::numeric_limits<double>::infinity();

World Fig1World(int k) {
  World w(*Layout::Rectangles({{-kInf, 0, 0, kInf}, {0, kInf, 0, kInf}, {-kInf, kInf, -kInf, 0}}));
  w.environment.gravity = Vec3::Zero();
  w.exchange.k = k;
  w.exchange.recovery = 0;
  w.environment.speed_limit = w.tolerances.speed;
  return w;
}

BodySpec Ball(BodyId id, double x, double z, double vx = 0, double vz = 0) {
  auto shape = std::make_shared<Shape>();
  shape->radius = 0.3;
  BodySpec b;
  b.id = id;
  b.shape = shape;
  b.position = {x, 0, z};
  b.velocity = {vx, 0, vz};
  return b;
}

class Fig1 : public testing::TestWithParam<int> {
 protected:
  World world_ = Fig1World(GetParam());
};

TEST_P(Fig1, ABMeetAcrossTheBorderAsInOneWorld) {
  world_.bodies = {Ball(1, -8, 20, 10), Ball(2, 8, 20, -10)};
  Lockstep split(world_);
  Undivided whole(split.world());
  EXPECT_EQ(split.Owner(1), 0);
  EXPECT_EQ(split.Owner(2), 1);
  for (Tick n = 1; n <= 100; ++n) {
    split.RunTo(n);
    whole.RunTo(n);
    ASSERT_EQ(split.Hash(), whole.Hash()) << "tick " << n;
  }
  EXPECT_LT(whole.engine().View(1).velocity.x(), 0) << "they must have bounced";
  EXPECT_GT(split.BodiesMoved(), 0);
}

TEST_P(Fig1, DMovesToTheServerOfCWhoseAuraItEnters) {
  // C rests on the border and is mostly server 0's; D comes from server 1.
  world_.bodies = {Ball(3, -0.1, 40), Ball(4, 26, 40, -10)};
  Lockstep split(world_);
  ASSERT_EQ(split.Owner(3), 0);
  ASSERT_EQ(split.Owner(4), 1);
  bool joined = false;
  for (Tick n = 1; n <= 200 && !joined; ++n) {
    split.RunTo(n);
    joined = split.Owner(4) == split.Owner(3);
  }
  EXPECT_TRUE(joined);
  EXPECT_EQ(split.Owner(3), 0) << "C stays, D goes";
}

TEST_P(Fig1, EFGAreNoIslandWhileEIsOnTheBorder) {
  // All owned by server 0: a row that touches, E on the border, F and G in server 1's region. G is light, so that most
  // of the mass is at home.
  world_.bodies = {Ball(5, -0.2, 20), Ball(6, 0.38, 20), Ball(7, 0.95, 20)};
  world_.bodies[0].mass = 10;
  Lockstep split(world_);
  split.RunTo(100);
  for (BodyId id : {5, 6, 7}) EXPECT_EQ(split.Owner(id), 0) << "body " << id;
  EXPECT_EQ(split.BodiesMoved(), 0);
}

TEST_P(Fig1, HIJAreAnIslandAndGoToServer2Together) {
  // A row that touches flies from server 0 into server 2.
  world_.bodies = {Ball(8, -40, 1, 0, -5), Ball(9, -40.5, 1, 0, -5), Ball(10, -41, 1, 0, -5)};
  Lockstep split(world_);
  ASSERT_EQ(split.Owner(8), 0);
  split.RunTo(150);
  for (BodyId id : {8, 9, 10}) EXPECT_EQ(split.Owner(id), 2) << "body " << id;
  EXPECT_EQ(split.BodiesMoved(), 3) << "once each";
  EXPECT_GE(split.region(0).stats().touching_out, 1) << "as a group";
}

TEST_P(Fig1, KDoesNotThrashBetweenLAndM) {
  // K lies between L of server 0 and M of server 1, inside the auras of both; they touch in turn.
  world_.bodies = {Ball(11, 0.02, 20), Ball(12, -3, 20, 5), Ball(13, 3, 20, -5)};
  Lockstep split(world_);
  Undivided whole(split.world());
  for (Tick n = 1; n <= 200; ++n) {
    split.RunTo(n);
    whole.RunTo(n);
    ASSERT_EQ(split.Hash(), whole.Hash()) << "tick " << n;
  }
  EXPECT_LE(split.BodiesMoved(), 9) << "each of the three may join, and go home, but not to and fro";
}

TEST_P(Fig1, NAndOMeetAtTheCornerThoughOnlyAThirdServerSeesBoth) {
  // N of server 2 and O of server 1 meet inside the region of server 0: each is away from home.
  world_.bodies = {Ball(14, -20, -19, 8, 8), Ball(15, 21, 21.7, -8, -8)};
  Lockstep split(world_);
  ASSERT_EQ(split.Owner(14), 2);
  ASSERT_EQ(split.Owner(15), 1);
  Undivided whole(split.world());
  for (Tick n = 1; n <= 250; ++n) {
    split.RunTo(n);
    whole.RunTo(n);
    ASSERT_EQ(split.Hash(), whole.Hash()) << "tick " << n;
  }
  EXPECT_NE(whole.engine().View(14).velocity, Vec3(8, 0, 8)) << "they must have met";
}

INSTANTIATE_TEST_SUITE_P(EveryDelay, Fig1, testing::Values(0, 1, 2, 3),
                         [](const auto& param) { return "k" + std::to_string(param.param); });

}  // namespace
}  // namespace aureole::sim
