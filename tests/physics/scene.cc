#include "tests/physics/scene.h"

#include <algorithm>
#include <cmath>

namespace aureole {
namespace {

// Ids are unrelated to the order of creation.
BodyId IdOf(uint64_t key) { return (Mix(key) >> 8) | 1; }

Quat RandomTurn(uint64_t key) {
  Quat q(Uniform(key, -1, 1), Uniform(key + 1, -1, 1), Uniform(key + 2, -1, 1), Uniform(key + 3, 0.1, 1));
  q.normalize();
  return q;
}

Vec3 RandomVector(uint64_t key, double from, double to) {
  return {Uniform(key, from, to), Uniform(key + 1, from, to), Uniform(key + 2, from, to)};
}

// One in nine is so large that its contact points reach beyond the exact boxes, where only the gate stops them.
std::shared_ptr<const Shape> RandomShape(uint64_t key, int kind) {
  auto s = std::make_shared<Shape>();
  const Vec3 e = RandomVector(key, 0.25, 0.55) * (Mix(key + 50) % 9 == 0 ? 3.5 : 1);
  switch (kind) {
    case 0:
      return SphereShape(e.x());
    case 1:
      return BoxShape(e.x(), e.y(), e.z());
    case 2:
      return CapsuleShape(0.6 * e.x(), 0.6 * e.x() + e.y());
    case 3:
      s->kind = ShapeKind::kCylinder;
      s->radius = e.x();
      s->half.y() = e.y();
      return s;
    case 4:
      s->kind = ShapeKind::kHull;
      for (int i = 0; i < 8; ++i) {
        const Vec3 corner((i & 1) != 0 ? 1 : -1, (i & 2) != 0 ? 1 : -1, (i & 4) != 0 ? 1 : -1);
        s->points.push_back(corner.cwiseProduct(e).cwiseProduct(RandomVector(key + 10 + 3 * i, 0.7, 1)));
      }
      return s;
    default:
      s->kind = ShapeKind::kCompound;
      s->children.push_back({Vec3(-e.x(), 0, 0), Quat::Identity(), BoxShape(e.x(), 0.6 * e.y(), e.z())});
      s->children.push_back({Vec3(e.x(), 0.5 * e.y(), 0), RandomTurn(key + 40), CapsuleShape(0.2, 0.45)});
      s->children.push_back({Vec3(0, 0, e.z()), Quat::Identity(), SphereShape(0.7 * e.z())});
      return s;
  }
}

Material RandomMaterial(uint64_t key) {
  Material m;
  m.friction = Uniform(key, 0.3, 0.9);
  if (Mix(key + 1) % 3 == 0) m.rolling_friction = 0.02;
  if (Mix(key + 2) % 4 == 0) m.spinning_friction = 0.03;
  if (Mix(key + 3) % 4 == 0) m.restitution = Uniform(key + 4, 0.1, 0.6);
  if (Mix(key + 5) % 2 == 0) m.linear_damping = Uniform(key + 6, 0, 0.1);
  return m;
}

BodySpec RandomBody(uint64_t key, int kind, const Vec3& position) {
  BodySpec b;
  b.id = IdOf(key);
  b.shape = RandomShape(key + 100, kind);
  b.mass = Uniform(key + 200, 0.5, 4.5);
  b.position = position;
  b.orientation = RandomTurn(key + 300);
  b.material = RandomMaterial(key + 400);
  b.ccd = Mix(key + 500) % 3 == 0;
  return b;
}

std::shared_ptr<const Shape> BumpyMesh(uint64_t key) {
  auto s = std::make_shared<Shape>();
  s->kind = ShapeKind::kMesh;
  constexpr uint32_t kSide = 13;
  for (uint32_t z = 0; z < kSide; ++z) {
    for (uint32_t x = 0; x < kSide; ++x) {
      s->points.emplace_back(0.6 * (x - 6.0), Uniform(key + z * 100 + x, 0, 0.3), 0.6 * (z - 6.0));
    }
  }
  for (uint32_t z = 0; z + 1 < kSide; ++z) {
    for (uint32_t x = 0; x + 1 < kSide; ++x) {
      const uint32_t a = z * kSide + x, b = a + 1, c = a + kSide, d = c + 1;
      for (uint32_t i : {a, c, b, b, c, d}) s->triangles.push_back(i);
    }
  }
  return s;
}

std::shared_ptr<const Shape> BumpyField(uint64_t key) {
  auto s = std::make_shared<Shape>();
  s->kind = ShapeKind::kHeightfield;
  s->rows = 9;
  s->columns = 11;
  s->cell = 0.75;
  for (int i = 0; i < s->rows * s->columns; ++i) s->heights.push_back(Uniform(key + i, 0, 0.35));
  return s;
}

void AddPedestal(uint64_t key, int which, const Vec3& base, PhysicsScene* scene) {
  switch (which % 4) {
    case 0:
      scene->environment.fixed.push_back(StaticBody(IdOf(key), BoxShape(3, 0.25, 3), base + Vec3(0, 0.25, 0)));
      break;
    case 1:
      scene->environment.fixed.push_back(StaticBody(IdOf(key), BumpyMesh(key), base + Vec3(0, 0.3, 0)));
      break;
    case 2:
      scene->environment.fixed.push_back(StaticBody(IdOf(key), BumpyField(key), base + Vec3(0, 0.3, 0)));
      break;
    default:  // a bowl of boxes
      for (int i = 0; i < 2; ++i) {
        BodySpec b = StaticBody(IdOf(key + i), BoxShape(2, 0.2, 2.5), base + Vec3(i == 0 ? -1.4 : 1.4, 0.6, 0));
        b.orientation = Quat(Eigen::AngleAxisd(i == 0 ? -0.3 : 0.3, Vec3::UnitZ()));
        scene->environment.fixed.push_back(b);
      }
  }
}

void AddMover(uint64_t key, int which, const Vec3& base, PhysicsScene* scene) {
  BodySpec b = StaticBody(IdOf(key), BoxShape(0.5, 0.6, 1.5), base + Vec3(-4, 1.2, 0));
  b.motion = Motion::kKinematic;
  auto script = std::make_shared<Script>();
  const auto key_at = [&](double t, const Vec3& offset, double angle) {
    script->keys.push_back({t, b.position + offset, Quat(Eigen::AngleAxisd(angle, Vec3::UnitY()))});
  };
  if (which % 2 == 0) {  // a pusher that rests at both ends
    key_at(0, Vec3::Zero(), 0);
    key_at(1.5, Vec3(6, 0, 0), 0.4);
    key_at(3, Vec3(6, 0, 0), 0.4);
    key_at(4, Vec3::Zero(), 0);
    key_at(6, Vec3::Zero(), 0);
    script->period = 6;
  } else {  // a turntable
    b.shape = BoxShape(1.8, 0.1, 1.8);
    b.position = base + Vec3(1, 0.7, 0);
    for (int i = 0; i <= 8; ++i) key_at(i * 0.5, Vec3::Zero(), i * EIGEN_PI / 4);
    key_at(6.5, Vec3::Zero(), 0);
    script->period = 6.5;
  }
  b.script = script;
  scene->environment.fixed.push_back(b);
}

JointSpec RandomJoint(uint64_t key, const BodySpec& a, const BodySpec* b) {
  JointSpec j;
  j.id = IdOf(key);
  j.a = a.id;
  j.b = b == nullptr ? 0 : b->id;
  j.kind = static_cast<JointKind>(1 + Mix(key + 1) % 3);
  // Joined where they are: half way, in each body's frame.
  const Vec3 middle = b == nullptr ? Vec3(a.position + Vec3(0, 0.8, 0)) : Vec3(0.5 * (a.position + b->position));
  const Quat back_a = a.orientation.conjugate();
  const Quat back_b = b == nullptr ? Quat::Identity() : b->orientation.conjugate();
  j.pivot_a = back_a * (middle - a.position);
  j.pivot_b = b == nullptr ? middle : back_b * (middle - b->position);
  j.axis_a = (back_a * Vec3::UnitZ()).normalized();
  j.axis_b = (back_b * Vec3::UnitZ()).normalized();
  j.frame_a = back_a;
  j.frame_b = back_b;
  j.limited = Mix(key + 2) % 2 == 0;
  j.lower = -0.5;
  j.upper = 0.7;
  j.collide = Mix(key + 3) % 2 == 0;
  return j;
}

void AddInputs(uint64_t seed, int clusters, Tick ticks, double spacing, PhysicsScene* scene) {
  const int side = static_cast<int>(std::ceil(std::sqrt(clusters)));
  struct Target {
    BodyId id;
    bool ccd, gone;
  };
  std::vector<Target> targets;
  for (const BodySpec& b : scene->bodies) targets.push_back({b.id, b.ccd, false});
  for (Tick n = 50; n <= ticks; n += 50) {
    const uint64_t key = Mix(seed ^ static_cast<uint64_t>(n));
    uint64_t sequence = 0;
    const auto add = [&](Input::Kind kind) -> Input& {
      Input& in = scene->inputs.emplace_back();
      in.tick = n;
      in.sequence = ++sequence;
      in.kind = kind;
      return in;
    };
    for (size_t i = 0; i < targets.size(); ++i) {
      const uint64_t k = Mix(key + i);
      if (targets[i].gone || k % (targets[i].ccd ? 7 : 17) != 0) continue;
      Input& in = add(Mix(k) % 2 == 0 ? Input::Kind::kImpulse : Input::Kind::kVelocity);
      in.body = targets[i].id;
      // Some are shot so fast that only CCD keeps them.
      const double fast = Mix(k + 1) % 3 == 0 ? (targets[i].ccd ? 25 : 4) : 1;
      in.linear = fast * Vec3(Uniform(k + 2, -4, 4), Uniform(k + 3, 0, 4), Uniform(k + 4, -4, 4));
      in.angular = RandomVector(k + 5, -1, 1);
      if (Mix(k + 9) % 12 == 0) {
        add(Input::Kind::kRemove).body = targets[i].id;
        targets[i].gone = true;
      }
    }
    for (int i = 0; i < 2; ++i) {
      const uint64_t k = Mix(key + 1000 + static_cast<uint64_t>(i));
      const int c = static_cast<int>(k % static_cast<uint64_t>(clusters));
      const Vec3 place(c % side * spacing + Uniform(k + 1, -1, 1), 5, c / side * spacing + Uniform(k + 2, -1, 1));
      auto spawn = std::make_shared<BodySpec>(RandomBody(k + 3, static_cast<int>(k % 6), place));
      spawn->velocity = Vec3(0, -3, 0);
      targets.push_back({spawn->id, spawn->ccd, false});
      add(Input::Kind::kSpawn).spawn = spawn;
    }
  }
}

}  // namespace

uint64_t Mix(uint64_t x) {
  x += 0x9e3779b97f4a7c15;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9;
  x = (x ^ (x >> 27)) * 0x94d049bb133111eb;
  return x ^ (x >> 31);
}

double Uniform(uint64_t key, double from, double to) {
  return from + (to - from) * static_cast<double>(Mix(key) >> 11) * 0x1p-53;
}

std::shared_ptr<const Shape> SphereShape(double radius) {
  auto s = std::make_shared<Shape>();
  s->kind = ShapeKind::kSphere;
  s->radius = radius;
  return s;
}

std::shared_ptr<const Shape> BoxShape(double x, double y, double z) {
  auto s = std::make_shared<Shape>();
  s->kind = ShapeKind::kBox;
  s->half = Vec3(x, y, z);
  return s;
}

std::shared_ptr<const Shape> CapsuleShape(double radius, double half_height) {
  auto s = std::make_shared<Shape>();
  s->kind = ShapeKind::kCapsule;
  s->radius = radius;
  s->half.y() = half_height;
  return s;
}

BodySpec StaticBody(BodyId id, std::shared_ptr<const Shape> shape, const Vec3& position) {
  BodySpec b;
  b.id = id;
  b.motion = Motion::kStatic;
  b.shape = std::move(shape);
  b.position = position;
  return b;
}

BodySpec GroundPlane(BodyId id) {
  auto s = std::make_shared<Shape>();
  s->kind = ShapeKind::kPlane;
  return StaticBody(id, s, Vec3::Zero());
}

PhysicsScene MakePhysicsScene(uint64_t seed, int clusters, int per, Tick ticks) {
  constexpr double kSpacing = 11;
  PhysicsScene scene;
  scene.environment.speed_limit = seed % 2 == 0 ? 0 : 90;
  scene.environment.fixed.push_back(GroundPlane(IdOf(seed)));
  const int side = static_cast<int>(std::ceil(std::sqrt(clusters)));
  for (int c = 0; c < clusters; ++c) {
    const uint64_t key = Mix(seed * 7919 + static_cast<uint64_t>(c));
    const Vec3 base(c % side * kSpacing, 0, c / side * kSpacing);
    AddPedestal(key, c, base, &scene);
    if (c % 3 != 2) AddMover(key + 50, c % 3, base, &scene);
    for (int i = 0; i < per; ++i) {
      const uint64_t k = Mix(key + 1000 + static_cast<uint64_t>(i));
      const bool joined = i % 5 >= 3;  // chains of three: joints that share a body
      const Vec3 fall = base + Vec3(Uniform(k, -1.5, 1.5), 2 + i * 0.8, Uniform(k + 1, -1.5, 1.5));
      const Vec3 beside = i == 0 ? fall : Vec3(scene.bodies.back().position + Vec3(1.3, 0, 0));
      scene.bodies.push_back(RandomBody(k + 2, i % 6, joined ? beside : fall));
      if (!joined) continue;
      const BodySpec& b = scene.bodies.back();
      scene.joints.push_back(RandomJoint(k + 3, b, i % 10 == 9 ? nullptr : &scene.bodies[scene.bodies.size() - 2]));
    }
  }
  AddInputs(seed, clusters, ticks, kSpacing, &scene);
  return scene;
}

std::vector<BodySpec> MakeUnrelated(uint64_t seed, int count) {
  std::vector<BodySpec> bodies;
  for (int i = 0; i < count; ++i) {
    const uint64_t k = Mix(seed + static_cast<uint64_t>(i)) ^ 0x5555;
    bodies.push_back(RandomBody(k, i % 6, Vec3(3000, 3, 0) + RandomVector(k + 1, -4, 4)));
  }
  return bodies;
}

}  // namespace aureole
