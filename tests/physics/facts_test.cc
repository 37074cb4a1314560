// Plain facts of physics, and of the engine's contract.
#include <cmath>
#include <numbers>

#include <gtest/gtest.h>

#include "server/physics/bullet_engine.h"
#include "tests/physics/scene.h"

namespace aureole {
namespace {

Environment Ground() {
  Environment e;
  e.fixed.push_back(GroundPlane(1));
  return e;
}

BodySpec Dynamic(BodyId id, std::shared_ptr<const Shape> shape, const Vec3& position) {
  BodySpec b;
  b.id = id;
  b.shape = std::move(shape);
  b.position = position;
  b.material.angular_damping = 0;
  return b;
}

// Steps from tick `from` (exclusive) to `to`.
void Advance(Engine* engine, Tick from, Tick to) {
  for (Tick n = from + 1; n <= to; ++n) engine->Step(n);
}

Input Kick(BodyId id, const Vec3& impulse) {
  Input in;
  in.kind = Input::Kind::kImpulse;
  in.body = id;
  in.linear = impulse;
  return in;
}

TEST(Physics, FreeFallIsSemiImplicitEuler) {
  const Environment e = Ground();
  const auto engine = MakeBulletEngine(e);
  engine->Spawn(Dynamic(7, SphereShape(0.5), Vec3(3, 50, -2)));
  double y = 50, v = 0;
  for (Tick n = 1; n <= 60; ++n) {
    engine->Step(n);
    v += e.gravity.y() * e.dt();
    y += v * e.dt();
    const BodyView view = engine->View(7);
    ASSERT_NEAR(view.velocity.y(), v, 1e-12);
    ASSERT_NEAR(view.centre.y(), y, 1e-11);
    ASSERT_EQ(view.centre.x(), 3);
  }
}

TEST(Physics, ImpulseAtAPointTurnsABodyAsItsMomentDoes) {
  Environment e = Ground();
  e.gravity.setZero();
  const auto engine = MakeBulletEngine(e);
  const Quat turned(Eigen::AngleAxisd(0.7, Vec3(1, 2, 3).normalized()));
  for (BodyId id : {11, 12, 13}) {
    BodySpec b = Dynamic(id, BoxShape(0.5, 0.3, 0.2), Vec3(static_cast<double>(id - 10) * 5, 5, 0));
    b.orientation = turned;
    engine->Spawn(b);
  }
  const Vec3 impulse(0.3, -0.2, 0.9), lever(0.4, 0.1, -0.2);
  Input moment = Kick(11, impulse);
  moment.angular = (turned * lever).cross(impulse);
  Input at_world = Kick(12, impulse);
  at_world.frame = Input::Frame::kWorld;
  at_world.point = Vec3(10, 5, 0) + turned * lever;
  Input at_body = Kick(13, impulse);
  at_body.frame = Input::Frame::kBody;
  at_body.point = lever;
  for (const Input& i : {moment, at_world, at_body}) engine->Apply(i);
  Advance(engine.get(), 0, 50);
  const Quat first = engine->Pose(11).orientation;
  EXPECT_GT(first.angularDistance(turned), 0.3);
  for (BodyId id : {12, 13}) {
    EXPECT_LT(engine->Pose(id).orientation.angularDistance(first), 1e-9) << id;
    EXPECT_LT((engine->View(id).velocity - engine->View(11).velocity).norm(), 1e-12) << id;
  }
}

TEST(Physics, RayHitsTheNearestBodyWhereItsSurfaceIs) {
  const auto engine = MakeBulletEngine(Ground());
  BodySpec turned = Dynamic(11, BoxShape(0.5, 0.5, 0.5), Vec3(0, 5, 0));
  turned.orientation = Quat(Eigen::AngleAxisd(3.14159265358979323846 / 4, Vec3::UnitY()));
  engine->Spawn(turned);
  engine->Spawn(Dynamic(12, SphereShape(1), Vec3(10, 5, 0)));
  std::optional<RayHit> hit = engine->CastRay(Vec3(-10, 5, 0), Vec3(20, 5, 0));
  ASSERT_TRUE(hit.has_value());
  EXPECT_EQ(hit->id, 11u);
  EXPECT_FALSE(hit->fixed);
  EXPECT_NEAR(hit->fraction, (10 - std::sqrt(0.5)) / 30, 0.05 / 30);
  hit = engine->CastRay(Vec3(10, 50, 0), Vec3(10, -50, 0));
  ASSERT_TRUE(hit.has_value());
  EXPECT_EQ(hit->id, 12u);
  EXPECT_NEAR(hit->fraction, 0.44, 1e-3);
  EXPECT_NEAR(hit->normal.y(), 1, 1e-3);
  hit = engine->CastRay(Vec3(30, 50, 0), Vec3(30, -50, 0));
  ASSERT_TRUE(hit.has_value());
  EXPECT_TRUE(hit->fixed) << "the ground";
  EXPECT_NEAR(hit->fraction, 0.5, 1e-6);
  EXPECT_FALSE(engine->CastRay(Vec3(30, 50, 0), Vec3(30, 90, 0)).has_value());
}

TEST(Physics, ChangeOfVelocityAddsWhateverTheMass) {
  const auto engine = MakeBulletEngine(Ground());
  BodySpec b = Dynamic(7, SphereShape(0.5), Vec3(0, 9, 0));
  b.mass = 400;
  b.velocity = {1, 0, 0};
  engine->Spawn(b);
  Input change = Kick(7, Vec3(2, 0, -1));
  change.kind = Input::Kind::kVelocityChange;
  engine->Apply(change);
  EXPECT_EQ(engine->View(7).velocity, Vec3(3, 0, -1));
}

TEST(Physics, LeastInertiaIsTheSmallestPrincipalMoment) {
  const auto engine = MakeBulletEngine(Ground());
  BodySpec b = Dynamic(7, BoxShape(0.5, 0.3, 0.2), Vec3(0, 9, 0));
  b.mass = 12;
  engine->Spawn(b);
  EXPECT_NEAR(engine->View(7).least_inertia, 4 * (0.3 * 0.3 + 0.2 * 0.2), 1e-3);
}

TEST(Physics, RestingBoxSleepsAfterTheSleepTime) {
  const auto engine = MakeBulletEngine(Ground());
  engine->Spawn(Dynamic(7, BoxShape(0.5, 0.5, 0.5), Vec3(0, 0.5, 0)));
  Advance(engine.get(), 0, 25);  // 0.4 s
  EXPECT_FALSE(engine->View(7).asleep);
  engine->Step(26);
  const BodyView view = engine->View(7);
  EXPECT_TRUE(view.asleep);
  EXPECT_EQ(view.velocity, Vec3::Zero());
  EXPECT_NEAR(view.centre.y(), 0.5, 0.02);
  EXPECT_EQ(engine->Counts().awake, 0);
  const uint64_t hash = engine->Hash(7);
  Advance(engine.get(), 26, 100);
  EXPECT_EQ(engine->Hash(7), hash);
}

TEST(Physics, StruckSleeperWakesAndMoves) {
  const auto engine = MakeBulletEngine(Ground());
  engine->Spawn(Dynamic(7, BoxShape(0.5, 0.5, 0.5), Vec3(0, 0.5, 0)));
  Advance(engine.get(), 0, 60);
  ASSERT_TRUE(engine->View(7).asleep);
  BodySpec striker = Dynamic(8, SphereShape(0.4), Vec3(-4, 0.5, 0));
  striker.velocity = Vec3(10, 0, 0);
  striker.mass = 3;
  engine->Spawn(striker);
  Advance(engine.get(), 60, 100);
  EXPECT_FALSE(engine->View(7).asleep);
  EXPECT_GT(engine->View(7).centre.x(), 0.5);
}

TEST(Physics, SleepingHeapWakesWhole) {
  const auto engine = MakeBulletEngine(Ground());
  for (int i = 0; i < 4; ++i) {
    engine->Spawn(Dynamic(10 + static_cast<BodyId>(i), BoxShape(0.5, 0.5, 0.5), Vec3(0, 0.5 + i, 0)));
  }
  Advance(engine.get(), 0, 200);
  ASSERT_EQ(engine->Counts().awake, 0);
  engine->Apply(Kick(13, Vec3(0.1, 0, 0)));
  EXPECT_EQ(engine->Counts().awake, 1);
  engine->Step(201);
  EXPECT_EQ(engine->Counts().awake, 4);
}

TEST(Physics, RestitutionBounces) {
  Environment e = Ground();
  e.fixed[0].material.restitution = 1;
  const auto engine = MakeBulletEngine(e);
  BodySpec ball = Dynamic(7, SphereShape(0.5), Vec3(0, 5.5, 0));
  ball.material.restitution = 0.8;
  engine->Spawn(ball);
  double fastest_up = 0;
  for (Tick n = 1; n <= 100; ++n) {
    engine->Step(n);
    fastest_up = std::max(fastest_up, engine->View(7).velocity.y());
  }
  EXPECT_NEAR(fastest_up, 0.8 * std::sqrt(2 * 9.81 * 5), 0.25);
}

TEST(Physics, FrictionStopsASlidingBox) {
  Environment e = Ground();
  e.fixed[0].material.friction = 1;
  const auto engine = MakeBulletEngine(e);
  BodySpec box = Dynamic(7, BoxShape(0.5, 0.25, 0.5), Vec3(0, 0.25, 0));
  box.velocity = Vec3(4, 0, 0);
  box.material.friction = 0.5;
  engine->Spawn(box);
  Advance(engine.get(), 0, 120);
  // v^2 / (2 mu g)
  EXPECT_NEAR(engine->View(7).centre.x(), 16 / (2 * 0.5 * 9.81), 0.15);
}

TEST(Physics, RollingFrictionStopsABall) {
  const auto engine = MakeBulletEngine(Ground());
  for (BodyId id : {7, 8}) {
    BodySpec ball = Dynamic(id, SphereShape(0.5), Vec3(0, 0.5, id == 7 ? 0 : 5));
    ball.velocity = Vec3(3, 0, 0);
    if (id == 8) ball.material.rolling_friction = 0.5;
    engine->Spawn(ball);
  }
  Advance(engine.get(), 0, 250);
  EXPECT_FALSE(engine->View(7).asleep);
  EXPECT_TRUE(engine->View(8).asleep);
}

TEST(Physics, LinearDampingTakesItsShare) {
  Environment e;
  e.gravity = Vec3::Zero();
  const auto engine = MakeBulletEngine(e);
  BodySpec body = Dynamic(7, SphereShape(0.5), Vec3::Zero());
  body.velocity = Vec3(10, 0, 0);
  body.material.linear_damping = 0.5;
  engine->Spawn(body);
  Advance(engine.get(), 0, 125);  // 2 s
  EXPECT_NEAR(engine->View(7).velocity.x(), 2.5, 1e-9);
}

JointSpec JointTo(JointKind kind, BodyId a, BodyId b, const Vec3& pivot_a, const Vec3& pivot_b) {
  JointSpec j;
  j.id = 99;
  j.kind = kind;
  j.a = a;
  j.b = b;
  j.pivot_a = pivot_a;
  j.pivot_b = pivot_b;
  return j;
}

TEST(Physics, HingeStopsAtItsLimits) {
  Environment e;
  const auto engine = MakeBulletEngine(e);
  engine->Spawn(Dynamic(7, BoxShape(1, 0.1, 0.1), Vec3(1, 10, 0)));
  JointSpec hinge = JointTo(JointKind::kHinge, 7, 0, Vec3(-1, 0, 0), Vec3(0, 10, 0));
  hinge.limited = true;
  hinge.lower = -0.6;
  hinge.upper = 0.6;
  engine->Join(hinge);
  double lowest = 0;
  for (Tick n = 1; n <= 300; ++n) {
    engine->Step(n);
    const Vec3 arm = engine->View(7).centre - Vec3(0, 10, 0);
    ASSERT_NEAR(arm.norm(), 1, 0.05);
    lowest = std::min(lowest, std::atan2(arm.y(), arm.x()));
  }
  EXPECT_NEAR(lowest, -0.6, 0.1);
  const Vec3 arm = engine->View(7).centre - Vec3(0, 10, 0);
  EXPECT_NEAR(std::atan2(arm.y(), arm.x()), -0.6, 0.05);
}

TEST(Physics, PointJointSwingsAtItsLength) {
  Environment e;
  e.sleep_linear = 0;
  const auto engine = MakeBulletEngine(e);
  engine->Spawn(Dynamic(7, SphereShape(0.2), Vec3(2, 10, 0)));
  engine->Join(JointTo(JointKind::kPoint, 7, 0, Vec3(-2, 0, 0), Vec3(0, 10, 0)));
  double lowest = 10;
  for (Tick n = 1; n <= 300; ++n) {
    engine->Step(n);
    ASSERT_NEAR((engine->View(7).centre - Vec3(0, 10, 0)).norm(), 2, 0.2);  // Bullet's joints give
    lowest = std::min(lowest, engine->View(7).centre.y());
  }
  EXPECT_NEAR(lowest, 8, 0.2);
}

TEST(Physics, FixedJointKeepsThePose) {
  const auto engine = MakeBulletEngine(Ground());
  engine->Spawn(Dynamic(7, BoxShape(0.5, 0.5, 0.5), Vec3(0, 3, 0)));
  engine->Spawn(Dynamic(8, BoxShape(0.5, 0.2, 0.2), Vec3(1, 3, 0)));
  engine->Join(JointTo(JointKind::kFixed, 7, 8, Vec3(0.5, 0, 0), Vec3(-0.5, 0, 0)));
  Input spin;
  spin.kind = Input::Kind::kVelocity;
  spin.body = 7;
  spin.angular = Vec3(1, 2, 3);
  engine->Apply(spin);
  for (Tick n = 1; n <= 200; ++n) {
    engine->Step(n);
    ASSERT_NEAR((engine->View(8).centre - engine->View(7).centre).norm(), 1, 0.06) << n;
  }
  std::vector<BodyId> partners;
  engine->Jointed(8, &partners);
  EXPECT_EQ(partners, std::vector<BodyId>{7});
}

TEST(Physics, JointedBodiesPassThroughEachOtherUnlessTheyCollide) {
  for (bool collide : {false, true}) {
    Environment e;
    e.gravity = Vec3::Zero();
    const auto engine = MakeBulletEngine(e);
    engine->Spawn(Dynamic(7, BoxShape(0.5, 0.5, 0.5), Vec3(0, 0, 0)));
    engine->Spawn(Dynamic(8, BoxShape(0.5, 0.5, 0.5), Vec3(0.8, 0, 0)));
    JointSpec j = JointTo(JointKind::kPoint, 7, 8, Vec3(0.4, 0, 0), Vec3(-0.4, 0, 0));
    j.collide = collide;
    engine->Join(j);
    engine->Step(1);
    EXPECT_EQ(engine->Counts().contacts > 0, collide);
  }
}

// A plate 2 cm thick, shot at with 300 m/s.
double ShootAtPlate(bool ccd, std::shared_ptr<const Shape> shape) {
  Environment e;
  e.gravity = Vec3::Zero();
  e.fixed.push_back(StaticBody(1, BoxShape(0.01, 2, 2), Vec3(5, 0, 0)));
  const auto engine = MakeBulletEngine(e);
  BodySpec bullet = Dynamic(7, std::move(shape), Vec3(-1, 0, 0));
  bullet.velocity = Vec3(300, 0, 0);
  bullet.ccd = ccd;
  engine->Spawn(bullet);
  double farthest = -1;
  for (Tick n = 1; n <= 10; ++n) {
    engine->Step(n);
    farthest = std::max(farthest, engine->View(7).centre.x());
  }
  return farthest;
}

TEST(Physics, BulletWithCcdDoesNotTunnel) {
  for (const auto& shape : {SphereShape(0.1), BoxShape(0.1, 0.1, 0.1), CapsuleShape(0.1, 0.2)}) {
    EXPECT_LT(ShootAtPlate(true, shape), 5);
    EXPECT_GT(ShootAtPlate(false, shape), 10);
  }
}

TEST(Physics, BulletWithCcdHitsADynamicBody) {
  Environment e;
  e.gravity = Vec3::Zero();
  const auto engine = MakeBulletEngine(e);
  BodySpec plate = Dynamic(6, BoxShape(0.01, 2, 2), Vec3(5, 0, 0));
  plate.mass = 100;
  engine->Spawn(plate);
  BodySpec bullet = Dynamic(7, SphereShape(0.1), Vec3(-1, 0, 0));
  bullet.velocity = Vec3(300, 0, 0);
  bullet.ccd = true;
  engine->Spawn(bullet);
  Advance(engine.get(), 0, 10);
  EXPECT_LT(engine->View(7).centre.x(), engine->View(6).centre.x());
  EXPECT_GT(engine->View(6).velocity.x(), 1);
}

TEST(Physics, SpeedLimitClampsSpawnsInputsAndSteps) {
  Environment e = Ground();
  e.speed_limit = 20;
  const auto engine = MakeBulletEngine(e);
  BodySpec body = Dynamic(7, SphereShape(0.5), Vec3(0, 1000, 0));
  body.velocity = Vec3(30, 40, 0);
  engine->Spawn(body);
  EXPECT_NEAR((engine->View(7).velocity - Vec3(12, 16, 0)).norm(), 0, 1e-12);
  engine->Apply(Kick(7, Vec3(0, 0, 500)));
  EXPECT_NEAR(engine->View(7).velocity.norm(), 20, 1e-12);
  for (Tick n = 1; n <= 300; ++n) {
    engine->Step(n);
    ASSERT_LE(engine->View(7).velocity.norm(), 20 + 1e-12);
  }
  EXPECT_NEAR(engine->View(7).velocity.norm(), 20, 0.1);
}

TEST(Physics, ABodyThatIsStruckHoweverHardStaysInSpace) {
  const auto engine = MakeBulletEngine(Ground());
  BodySpec body = Dynamic(7, SphereShape(0.001), Vec3(0, 1, 0));
  body.mass = 1e-6;
  body.ccd = true;
  engine->Spawn(body);
  engine->Spawn(Dynamic(8, BoxShape(0.5, 0.5, 0.5), Vec3(3, 0.5, 0)));
  Tick n = 0;
  for (double newton_seconds : {1e9, 1e12}) {
    Input kick = Kick(7, Vec3(newton_seconds, newton_seconds, 0));
    kick.angular = Vec3(0, newton_seconds, 0);
    engine->Apply(kick);
    for (Tick end = n + 200; n < end;) engine->Step(++n);
    const BodyPose pose = engine->Pose(7);
    EXPECT_LE(pose.velocity.norm(), 1.001e5);
    EXPECT_LE(pose.angular_velocity.norm(), 1.001e5);
    EXPECT_LT(pose.position.norm(), 1e8);
    const std::string state = engine->Save(std::vector<BodyId>{7});
    EXPECT_TRUE(engine->Scratch()->Restore(state).ok()) << "it can be handed over";
  }
}

TEST(Physics, KinematicPlatformCarriesABoxByFriction) {
  Environment e;
  BodySpec platform = StaticBody(1, BoxShape(3, 0.1, 3), Vec3(0, 0, 0));
  platform.motion = Motion::kKinematic;
  auto script = std::make_shared<Script>();
  script->keys = {
      {0, Vec3(0, 0, 0), Quat::Identity()}, {1, Vec3(0, 0, 0), Quat::Identity()}, {5, Vec3(4, 0, 0), Quat::Identity()}};
  platform.script = script;
  e.fixed.push_back(platform);
  const auto engine = MakeBulletEngine(e);
  engine->Spawn(Dynamic(7, BoxShape(0.5, 0.5, 0.5), Vec3(0, 0.6, 0)));
  Advance(engine.get(), 0, 60);
  EXPECT_TRUE(engine->View(7).asleep);  // the platform rests for its first second
  Advance(engine.get(), 60, 250);       // 4 s
  EXPECT_FALSE(engine->View(7).asleep);
  EXPECT_NEAR(engine->View(7).centre.x(), 3, 0.15);
  Advance(engine.get(), 250, 400);
  EXPECT_TRUE(engine->View(7).asleep);
  EXPECT_NEAR(engine->View(7).centre.x(), 4, 0.25);
}

TEST(Physics, EveryShapeRestsOnEveryGround) {
  const PhysicsScene scene = MakePhysicsScene(11, 4, 12, 0);
  const auto engine = MakeBulletEngine(scene.environment);
  for (const BodySpec& b : scene.bodies) engine->Spawn(b);
  Advance(engine.get(), 0, 600);
  for (BodyId id : engine->Ids()) EXPECT_GT(engine->View(id).centre.y(), 0.05) << id;
}

TEST(Engine, RemovalWakesWhatTheBodyTouched) {
  const auto engine = MakeBulletEngine(Ground());
  engine->Spawn(Dynamic(7, BoxShape(0.5, 0.5, 0.5), Vec3(0, 0.5, 0)));
  engine->Spawn(Dynamic(8, BoxShape(0.5, 0.5, 0.5), Vec3(0, 1.5, 0)));
  engine->Spawn(Dynamic(9, BoxShape(0.5, 0.5, 0.5), Vec3(5, 0.5, 0)));
  Advance(engine.get(), 0, 100);
  ASSERT_EQ(engine->Counts().awake, 0);
  Input remove;
  remove.kind = Input::Kind::kRemove;
  remove.body = 7;
  engine->Apply(remove);
  EXPECT_FALSE(engine->Contains(7));
  EXPECT_FALSE(engine->View(8).asleep);
  EXPECT_TRUE(engine->View(9).asleep);
  Advance(engine.get(), 100, 160);
  EXPECT_NEAR(engine->View(8).centre.y(), 0.5, 0.02);
}

TEST(Engine, RemovalDeletesJointsAndWakesThePartner) {
  Environment e;
  e.gravity = Vec3::Zero();
  const auto engine = MakeBulletEngine(e);
  for (BodyId id : {7, 8}) {
    BodySpec b = Dynamic(id, SphereShape(0.1), Vec3(id == 7 ? 0 : 2, 0, 0));
    b.asleep = true;
    engine->Spawn(b);
  }
  engine->Join(JointTo(JointKind::kPoint, 7, 8, Vec3(1, 0, 0), Vec3(-1, 0, 0)));
  Input remove;
  remove.kind = Input::Kind::kRemove;
  remove.body = 8;
  engine->Apply(remove);
  std::vector<BodyId> partners;
  engine->Jointed(7, &partners);
  EXPECT_TRUE(partners.empty());
  EXPECT_FALSE(engine->View(7).asleep);
}

TEST(Engine, ExtractWakesNobody) {
  const auto engine = MakeBulletEngine(Ground());
  engine->Spawn(Dynamic(7, BoxShape(0.5, 0.5, 0.5), Vec3(0, 0.5, 0)));
  engine->Spawn(Dynamic(8, BoxShape(0.5, 0.5, 0.5), Vec3(3, 0.5, 0)));
  Advance(engine.get(), 0, 100);
  const BodyId id = 7;
  const std::string state = engine->Extract({&id, 1});
  Advance(engine.get(), 100, 110);
  EXPECT_TRUE(engine->View(8).asleep);
  ASSERT_TRUE(engine->Restore(state).ok());
  EXPECT_TRUE(engine->View(7).asleep);
}

// Turned at random, every box of a body stays within its radius.
TEST(Engine, RadiusBoundsTheBoxInEveryOrientation) {
  const PhysicsScene scene = MakePhysicsScene(6, 3, 18, 0);
  const auto engine = MakeBulletEngine(scene.environment);
  for (const BodySpec& b : scene.bodies) engine->Spawn(b);
  for (Tick n = 1; n <= 200; ++n) {
    engine->Step(n);
    for (BodyId id : engine->Ids()) {
      const BodyView v = engine->View(id);
      ASSERT_LE((v.box.max - v.centre).maxCoeff(), v.radius);
      ASSERT_LE((v.centre - v.box.min).maxCoeff(), v.radius);
      ASSERT_LE(v.radius, engine->MaxRadius());
    }
  }
}

TEST(Engine, BoxIsTheShapesBoxAndTheBreakingMargin) {
  const auto engine = MakeBulletEngine(Environment());
  BodySpec slow = Dynamic(7, SphereShape(0.5), Vec3(1, 2, 3)), fast = Dynamic(8, SphereShape(0.5), Vec3(1, 2, 3));
  fast.ccd = true;
  fast.velocity = slow.velocity = Vec3(100, 0, 0);
  engine->Spawn(slow);
  engine->Spawn(fast);
  EXPECT_EQ(engine->View(7).box.min, Vec3(1 - 0.52, 2 - 0.52, 3 - 0.52));
  EXPECT_EQ(engine->View(7).box.max, Vec3(1 + 0.52, 2 + 0.52, 3 + 0.52));
  EXPECT_NEAR(engine->View(8).box.max.x(), 1 + 0.52 + 1.6, 1e-12);
  EXPECT_NEAR(engine->View(8).box.min.y(), 2 - 0.52 - 9.81 * 0.016 * 0.016, 1e-12);
}

TEST(Engine, QueryAndCollectOutsideAgreeWithTheBoxes) {
  const PhysicsScene scene = MakePhysicsScene(7, 8, 12, 0);
  const auto engine = MakeBulletEngine(scene.environment);
  for (const BodySpec& b : scene.bodies) engine->Spawn(b);
  Rect rect{3, 18, -2, 14};
  for (Tick n = 1; n <= 400; ++n) {
    engine->Step(n);
    if (n == 300) rect.max_x = 12;  // and the list of sleepers is made anew
    if (n % 25 == 0) {
      const BodyId kicked = scene.bodies[static_cast<size_t>(n) % scene.bodies.size()].id;
      engine->Apply(Kick(kicked, Vec3(1, 3, 1)));
    }
    const Box box{Vec3(2, 0, -1), Vec3(9, 1.5, 8)};
    std::vector<BodyId> hits, outside, want_hits, want_outside;
    engine->Query(box, &hits);
    engine->CollectOutside(rect, 0.5, &outside);
    for (BodyId id : engine->Ids()) {
      const Box b = engine->View(id).box;
      if (Overlap(b, box)) want_hits.push_back(id);
      if (!rect.Encloses(b, 0.5)) want_outside.push_back(id);
    }
    ASSERT_EQ(hits, want_hits);
    ASSERT_EQ(outside, want_outside);
  }
  EXPECT_LT(engine->Counts().awake, engine->Counts().bodies);
}

TEST(EngineDeathTest, BrokenPreconditionNamesTheBody) {
  const auto engine = MakeBulletEngine(Environment());
  EXPECT_DEATH(engine->View(4711), "body 4711 is not here");
}

}  // namespace
}  // namespace aureole
