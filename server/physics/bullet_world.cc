#include "server/physics/bullet_world.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "server/core/check.h"
#include "server/physics/ccd.h"
#include "server/physics/joints.h"
#include "server/physics/script_pose.h"

namespace aureole::physics {
namespace {

// For printf.
unsigned long long Printable(uint64_t id) { return id; }

uint32_t TicksOf(double seconds, double dt) {
  const double ticks = std::ceil(seconds / dt - 1e-9);
  return ticks < 4e9 ? static_cast<uint32_t>(std::max(ticks, 1.0)) : std::numeric_limits<uint32_t>::max();
}

btRigidBody::btRigidBodyConstructionInfo Construction(double mass, const CollisionShape& shape, const Material& m) {
  btVector3 inertia(0, 0, 0);
  if (mass > 0) shape.whole->calculateLocalInertia(mass, inertia);
  btRigidBody::btRigidBodyConstructionInfo info(mass, nullptr, shape.whole, inertia);
  info.m_friction = m.friction;
  info.m_rollingFriction = m.rolling_friction;
  info.m_spinningFriction = m.spinning_friction;
  info.m_restitution = m.restitution;
  return info;
}

// Not idempotent in the last bit, so it belongs where a velocity changes, not where a state is restored.
btVector3 AtMost(double limit, const btVector3& v) {
  const double length2 = v.length2();
  return length2 > limit * limit ? v * (limit / std::sqrt(length2)) : v;
}

bool Outside(const Body& b, const Rect& rect, double margin) {
  return !rect.Encloses({FromBullet(b.low), FromBullet(b.high)}, margin);
}

}  // namespace

BulletWorld::BulletWorld(std::shared_ptr<Surroundings> surroundings, int pool)
    : surroundings_(std::move(surroundings)),
      environment_(surroundings_->environment),
      dt_(environment_.dt()),
      gravity_(ToBullet(environment_.gravity)),
      sleep_ticks_(TicksOf(environment_.sleep_after, dt_)),
      contacts_(pool, dt_),
      broadphase_([this](Pair& pair) { contacts_.Release(pair); }),
      anchor_(0, nullptr, nullptr) {
  solver_info_.m_numIterations = environment_.iterations;
  solver_info_.m_timeStep = dt_;
  for (size_t i = 0; i < environment_.fixed.size(); ++i) {
    AddFixed(environment_.fixed[i], surroundings_->fixed_shapes[i]);
  }
}

BulletWorld::~BulletWorld() {
  joints_.clear();
  for (auto& [id, body] : bodies_) broadphase_.Remove(body.get());
  for (auto& [id, body] : fixed_) broadphase_.Remove(body.get());
}

Body* BulletWorld::Find(BodyId id) const {
  auto it = bodies_.find(id);
  return it == bodies_.end() ? nullptr : it->second.get();
}

Body* BulletWorld::FindAny(BodyId id) const {
  if (Body* body = Find(id)) return body;
  auto it = fixed_.find(id);
  return it == fixed_.end() ? nullptr : it->second.get();
}

void BulletWorld::AddFixed(const BodySpec& spec, const std::shared_ptr<const CollisionShape>& shape) {
  AUREOLE_CHECK(spec.motion != Motion::kDynamic && !fixed_.contains(spec.id), "fixed body %llu", Printable(spec.id));
  auto body = std::make_unique<Body>(spec.id, spec.motion, Construction(0, *shape, spec.material));
  Body* b = body.get();
  b->shape = shape;
  b->material = spec.material;
  b->script = spec.script;
  b->rigid.setUserPointer(b);
  btTransform pose = ToBullet(spec.orientation, spec.position);
  if (b->motion == Motion::kKinematic) {
    b->rigid.setCollisionFlags(btCollisionObject::CF_KINEMATIC_OBJECT);
    if (b->script != nullptr) {
      pose = PoseAt(*b->script, 0, pose);
      scripted_ = true;
    }
    kinematic_.insert(
        std::lower_bound(kinematic_.begin(), kinematic_.end(), b, [](Body* x, Body* y) { return x->id < y->id; }), b);
  }
  b->rigid.setWorldTransform(pose);
  RefreshBox(b);
  broadphase_.Insert(b);
  fixed_.emplace(spec.id, std::move(body));
}

BodyState BulletWorld::StateOf(const BodySpec& spec) const {
  BodyState s;
  s.id = spec.id;
  s.shape = surroundings_->shapes.Get(spec.shape);
  s.mass = spec.mass;
  s.material = spec.material;
  s.ccd = spec.ccd;
  s.pose = ToBullet(spec.orientation, spec.position);
  s.velocity = Clamped(ToBullet(spec.velocity));
  s.angular_velocity = ToBullet(spec.angular_velocity);
  s.asleep = spec.asleep;
  return s;
}

BodyState BulletWorld::StateOf(const Body& body) const {
  BodyState s;
  s.id = body.id;
  s.shape = body.shape;
  s.mass = body.mass;
  s.material = body.material;
  s.ccd = body.ccd;
  s.pose = body.rigid.getWorldTransform();
  s.velocity = body.rigid.getLinearVelocity();
  s.angular_velocity = body.rigid.getAngularVelocity();
  s.asleep = body.asleep;
  s.still = body.still;
  return s;
}

Body* BulletWorld::Add(const BodyState& s) {
  AUREOLE_CHECK(FindAny(s.id) == nullptr, "body %llu is already here", Printable(s.id));
  auto body = std::make_unique<Body>(s.id, Motion::kDynamic, Construction(s.mass, *s.shape, s.material));
  Body* b = body.get();
  b->shape = s.shape;
  b->mass = s.mass;
  b->material = s.material;
  b->ccd = s.ccd;
  b->linear_keep = std::pow(1 - s.material.linear_damping, dt_);
  b->angular_keep = std::pow(1 - s.material.angular_damping, dt_);
  b->asleep = s.asleep;
  b->still = s.still;
  b->rigid.setUserPointer(b);
  b->rigid.setWorldTransform(s.pose);
  b->rigid.updateInertiaTensor();
  b->rigid.setLinearVelocity(s.velocity);
  b->rigid.setAngularVelocity(s.angular_velocity);
  b->rigid.setGravity(gravity_);
  RefreshBox(b);
  max_radius_ = std::max(max_radius_, Radius(*b));
  broadphase_.Insert(b);
  bodies_.emplace(s.id, std::move(body));
  if (b->asleep) {
    NoteSleeper(b);
  } else {
    awake_unsorted_ = awake_unsorted_ || (!awake_.empty() && awake_.back()->id > b->id);
    awake_.push_back(b);
  }
  return b;
}

void BulletWorld::AddJoint(const JointSpec& spec) {
  Body* a = Find(spec.a);
  Body* b = spec.b == 0 ? nullptr : Find(spec.b);
  AUREOLE_CHECK(a != nullptr && (spec.b == 0 || b != nullptr) && !joints_.contains(spec.id),
                "joint %llu of bodies %llu and %llu", Printable(spec.id), Printable(spec.a), Printable(spec.b));
  auto joint = std::make_unique<Joint>();
  joint->spec = spec;
  joint->a = a;
  joint->b = b;
  joint->constraint = MakeConstraint(spec, a->rigid, b == nullptr ? anchor_ : b->rigid);
  a->joints.push_back(joint.get());
  if (b != nullptr) b->joints.push_back(joint.get());
  joints_.emplace(spec.id, std::move(joint));
}

void BulletWorld::Remove(Body* body) {
  while (!body->joints.empty()) {
    Joint* j = body->joints.back();
    for (Body* end : {j->a, j->b}) {
      if (end != nullptr) std::erase(end->joints, j);
    }
    joints_.erase(j->spec.id);
  }
  if (body->asleep) {
    ForgetSleeper(body);
  } else if (awake_unsorted_) {
    std::erase(awake_, body);
  } else {
    awake_.erase(std::lower_bound(awake_.begin(), awake_.end(), body, [](Body* x, Body* y) { return x->id < y->id; }));
  }
  broadphase_.Remove(body);
  bodies_.erase(body->id);
}

// Touching means contact points, not boxes: bodies that have contact points were stepped together, so one region knows
// them all, whereas a box may have come close just now from another region.
void BulletWorld::WakeNeighbours(Body* body) {
  for (Joint* j : body->joints) {
    if (Body* other = j->Other(body)) Wake(other);
  }
  std::vector<Manifold> manifolds;
  for (Pair* p : body->pairs) {
    Body* other = p->Other(body);
    if (!other->dynamic() || !BoxesOverlap(*body, *other)) continue;
    manifolds.clear();
    contacts_.List(*p, &manifolds);
    if (!manifolds.empty()) Wake(other);
  }
}

void BulletWorld::Wake(Body* body) {
  body->still = 0;
  if (!body->asleep) return;
  NoLongerAsleep(body);
  awake_.push_back(body);
  awake_unsorted_ = true;
}

void BulletWorld::NoLongerAsleep(Body* body) {
  if (note_sleep_) woke_.push_back(body->id);
  body->asleep = false;
  ForgetSleeper(body);
}

void BulletWorld::NoteSleep(bool on) {
  note_sleep_ = on;
  slept_.clear();
  woke_.clear();
}

void BulletWorld::TakeSleep(std::vector<BodyId>* slept, std::vector<BodyId>* woke) {
  slept->insert(slept->end(), slept_.begin(), slept_.end());
  woke->insert(woke->end(), woke_.begin(), woke_.end());
  slept_.clear();
  woke_.clear();
}

void BulletWorld::FallAsleep(Body* body) {
  if (note_sleep_) slept_.push_back(body->id);
  body->asleep = true;
  body->still = 0;
  body->rigid.setLinearVelocity(btVector3(0, 0, 0));
  body->rigid.setAngularVelocity(btVector3(0, 0, 0));
  if (body->swept > 0) {  // the box no longer holds a motion
    RefreshBox(body);
    broadphase_.Update(body, btVector3(0, 0, 0));
    broadphase_.Commit();
  }
  NoteSleeper(body);
}

// To be called before a box changes between steps. Contacts of boxes that have parted would be freed in the next step;
// where the change makes the boxes meet again, they must be gone all the same, as they are in a region that was sent
// the bodies.
void BulletWorld::ReleaseParted(Body* body) {
  for (Pair* p : body->pairs) {
    if (!BoxesOverlap(*p->a, *p->b)) contacts_.Release(*p);
  }
}

void BulletWorld::SetVelocities(Body* body, const btVector3& velocity, const btVector3& angular_velocity) {
  Wake(body);
  ReleaseParted(body);
  body->rigid.setLinearVelocity(Clamped(velocity));
  body->rigid.setAngularVelocity(ClampedSpin(angular_velocity));
  if (!body->ccd) return;
  RefreshBox(body);
  max_radius_ = std::max(max_radius_, Radius(*body));
  broadphase_.Update(body, btVector3(0, 0, 0));
  broadphase_.Commit();
}

btVector3 BulletWorld::Clamped(const btVector3& velocity) const {
  return AtMost(environment_.speed_limit > 0 ? std::min(environment_.speed_limit, kMostSpeed) : kMostSpeed, velocity);
}

btVector3 BulletWorld::ClampedSpin(const btVector3& angular_velocity) const {
  return AtMost(kMostSpin, angular_velocity);
}

// The exact box: a function of pose, and of velocity for fast bodies with CCD only (their sweeps must stay inside it).
void BulletWorld::RefreshBox(Body* body) const {
  const btVector3 margin(kBreakingMargin, kBreakingMargin, kBreakingMargin);
  body->shape->whole->getAabb(body->rigid.getWorldTransform(), body->low, body->high);
  body->low -= margin;
  body->high += margin;
  if (!body->dynamic()) return;
  body->swept = 0;
  if (body->ccd && !body->asleep) {
    const btVector3 coasting = body->rigid.getLinearVelocity() * dt_;
    const btVector3 falling = coasting + gravity_ * (dt_ * dt_);
    const double distance2 = std::max(coasting.length2(), falling.length2());
    if (MovesFast(*body, distance2)) {
      btVector3 least(0, 0, 0), most(0, 0, 0);
      for (const btVector3& d : {coasting, falling}) {
        least.setMin(d);
        most.setMax(d);
      }
      body->low += least;
      body->high += most;
      body->swept = std::sqrt(distance2);
    }
  }
  // Not a number fails too.
  AUREOLE_CHECK((body->high - body->low).length() < 1e13 && body->low.length() < 1e15, "body %llu has left space",
                Printable(body->id));
}

void BulletWorld::NoteSleeper(Body* body) const {
  if (outside_margin_ < 0 || !Outside(*body, outside_of_, outside_margin_)) return;
  body->outside = static_cast<int>(outside_.size());
  outside_.push_back(body);
}

void BulletWorld::ForgetSleeper(Body* body) const {
  if (body->outside < 0) return;
  outside_.back()->outside = body->outside;
  outside_[static_cast<size_t>(body->outside)] = outside_.back();
  outside_.pop_back();
  body->outside = -1;
}

const std::vector<Body*>& BulletWorld::SleepersOutside(const Rect& rect, double margin) const {
  const bool same = outside_margin_ == margin && outside_of_.min_x == rect.min_x && outside_of_.max_x == rect.max_x &&
                    outside_of_.min_z == rect.min_z && outside_of_.max_z == rect.max_z;
  if (same) return outside_;
  for (Body* b : outside_) b->outside = -1;
  outside_.clear();
  outside_of_ = rect;
  outside_margin_ = margin;
  for (const auto& [id, body] : bodies_) {
    if (body->asleep) NoteSleeper(body.get());
  }
  return outside_;
}

}  // namespace aureole::physics
