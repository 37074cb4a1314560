// Rules of EXACT.md that show too rarely in random scenes.
#include <cmath>

#include <gtest/gtest.h>

#include "server/physics/bullet_engine.h"
#include "server/physics/bullet_world.h"
#include "server/physics/ccd.h"
#include "tests/physics/scene.h"

namespace aureole::physics {
namespace {

Environment Weightless() {
  Environment e;
  e.gravity = Vec3::Zero();
  return e;
}

BodySpec At(BodyId id, std::shared_ptr<const Shape> shape, const Vec3& position) {
  BodySpec b;
  b.id = id;
  b.shape = std::move(shape);
  b.position = position;
  return b;
}

// Bullet lets contact points of large bodies live beyond the breaking margin; only the gate keeps such points from
// existing where the bodies happen to be hosted together (L2).
TEST(ExactBoxes, BodiesWhoseBoxesAreApartHaveNoContacts) {
  for (double gap : {0.03, 0.05}) {
    const auto engine = MakeBulletEngine(Weightless());
    BodySpec left = At(7, CapsuleShape(2, 5), Vec3::Zero()), right = At(8, CapsuleShape(2, 5), Vec3(4 + gap, 0, 0));
    left.velocity = Vec3(0, 0.01, 0);
    engine->Spawn(left);
    engine->Spawn(right);
    engine->Step(1);
    EXPECT_EQ(engine->Counts().contacts > 0, gap < 2 * kBreakingMargin) << gap;
  }
}

class SweepRule : public testing::Test {
 protected:
  Body* Spawn(BodyId id, double radius, const Vec3& position) {
    BodySpec b = At(id, SphereShape(radius), position);
    b.ccd = true;
    return world_.Add(world_.StateOf(b));
  }
  static bool Ahead(const Body& body, SweepHit* hit) { return Sweep(body, btVector3(10, 0, 0), 0.016, hit); }

  BulletWorld world_{std::make_shared<Surroundings>(Weightless()), 16};
};

TEST_F(SweepRule, OnlyBodiesWhoseExactBoxesOverlapAreMet) {
  const Body* mover = Spawn(7, 0.5, Vec3::Zero());
  Spawn(8, 0.5, Vec3(1.06, 0, 0));  // 2 cm beyond the exact box, within the broadphase's fat one
  ASSERT_EQ(mover->pairs.size(), 1u);
  SweepHit hit;
  EXPECT_FALSE(Ahead(*mover, &hit));
  Body* close = Spawn(9, 0.5, Vec3(1.03, 0, 0));
  EXPECT_TRUE(Ahead(*mover, &hit));
  EXPECT_EQ(hit.other, close);
}

TEST_F(SweepRule, TiesGoToTheSmallerIdInEveryOrderOfCreation) {
  for (int order = 0; order < 8; ++order) {
    const BodyId base = 100 + 10 * static_cast<BodyId>(order);
    const Vec3 away(50 * order, 0, 0);
    const Body* mover = Spawn(base, 0.5, away);
    for (int i = 0; i < 4; ++i) {
      const int n = order < 4 ? (i + order) % 4 : (order - i) % 4;
      Spawn(base + 1 + static_cast<BodyId>(n), 0.5, away + Vec3(0.9, n % 2 == 0 ? 0.25 : -0.25, n < 2 ? 0.25 : -0.25));
    }
    SweepHit hit;
    ASSERT_TRUE(Ahead(*mover, &hit));
    EXPECT_EQ(hit.other->id, base + 1);
  }
}

// While boxes change one by one, a pair seems to part that does not; its contacts must outlive that.
TEST(Contacts, OfBodiesThatFlyTogetherLiveOn) {
  BulletWorld world(std::make_shared<Surroundings>(Weightless()), 16);
  for (BodyId id : {7, 8}) {  // 7 flies ahead and is updated first
    BodySpec b = At(id, CapsuleShape(0.5, 1), Vec3(id == 7 ? 0.98 : 0, 0, 0));
    b.velocity = Vec3(80, 0, 0);
    world.Add(world.StateOf(b));
  }
  for (Tick n = 1; n <= 3; ++n) {
    world.Step(n);
    ASSERT_EQ(world.Find(7)->pairs.size(), 1u);
    std::vector<Manifold> manifolds;
    world.contacts().List(*world.Find(7)->pairs[0], &manifolds);
    ASSERT_EQ(manifolds.size(), 1u);
    EXPECT_EQ(manifolds[0].points->getContactPoint(0).getLifeTime(), n);
  }
}

// One body with three joints: their order in the solver is that of their ids, whoever was joined first (L4).
TEST(Joints, OrderOfCreationChangesNoBit) {
  uint64_t first_hash = 0;
  for (int order = 0; order < 6; ++order) {
    const auto engine = MakeBulletEngine(Weightless());
    for (BodyId id = 1; id <= 4; ++id) {
      const double angle = 2.1 * static_cast<double>(id);
      BodySpec b = At(id, SphereShape(0.2), id == 1 ? Vec3(0, 0, 0) : Vec3(std::cos(angle), std::sin(angle), 0.3));
      b.velocity = Vec3(0.3, -static_cast<double>(id), static_cast<double>(id) * 0.7);
      engine->Spawn(b);
    }
    for (int i = 0; i < 3; ++i) {
      const BodyId other = 2 + static_cast<BodyId>(order < 3 ? (order + i) % 3 : (order - i) % 3);
      JointSpec j;
      j.id = 10 + other;
      j.a = 1;
      j.b = other;
      j.pivot_a = 0.5 * engine->View(other).centre;
      j.pivot_b = -j.pivot_a;
      engine->Join(j);
    }
    for (Tick n = 1; n <= 20; ++n) engine->Step(n);
    uint64_t hash = 0;
    for (BodyId id : engine->Ids()) hash = Mix(hash ^ engine->Hash(id));
    if (order == 0) first_hash = hash;
    EXPECT_EQ(hash, first_hash) << order;
  }
}

// Each of two bodies that are shot at each other sees the other where it was at the start of the tick: they meet, and
// the outcome is symmetric (L7).
TEST(Sweep, SeesBodiesWhereTheyWere) {
  const auto engine = MakeBulletEngine(Weightless());
  for (BodyId id : {7, 8}) {
    BodySpec b = At(id, SphereShape(0.2), Vec3(id == 7 ? -1 : 1, 0, 0));
    b.velocity = Vec3(id == 7 ? 100 : -100, 0, 0);
    b.ccd = true;
    engine->Spawn(b);
  }
  for (Tick n = 1; n <= 10; ++n) {
    engine->Step(n);
    ASSERT_NEAR(engine->View(7).centre.x(), -engine->View(8).centre.x(), 1e-9) << n;
    ASSERT_LT(engine->View(7).centre.x(), engine->View(8).centre.x()) << n;
  }
}

}  // namespace
}  // namespace aureole::physics
