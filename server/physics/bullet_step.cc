// One tick of BulletWorld.
#include <algorithm>
#include <tuple>

#include "server/physics/bullet_world.h"
#include "server/physics/ccd.h"
#include "server/physics/script_pose.h"

namespace aureole::physics {
namespace {

bool ById(const Body* x, const Body* y) { return x->id < y->id; }

}  // namespace

void BulletWorld::Step(Tick n) {
  tick_ = n;
  MoveKinematic(n);
  FindIslands();
  for (int i = 0; i < islands_; ++i) {
    const size_t begin = island_begin_[static_cast<size_t>(i)], end = island_begin_[static_cast<size_t>(i) + 1];
    SolveIsland(std::span<Body*>(ordered_).subspan(begin, end - begin));
  }
  Settle();
}

void BulletWorld::SetTick(Tick n) {
  tick_ = n;
  MoveKinematic(n);
}

// Poses and velocities are functions of the tick alone, also in an engine that was made in the middle of a run.
void BulletWorld::MoveKinematic(Tick n) {
  for (Body* b : kinematic_) {
    if (b->script == nullptr || b->script->keys.empty()) continue;
    const btTransform rest = b->rigid.getWorldTransform();
    const btTransform from = PoseAt(*b->script, static_cast<double>(n - 1) * dt_, rest);
    const btTransform to = PoseAt(*b->script, static_cast<double>(n) * dt_, rest);
    btVector3 linear(0, 0, 0), angular(0, 0, 0);
    b->moving = !(from == to);
    if (b->moving) btTransformUtil::calculateVelocity(from, to, dt_, linear, angular);
    b->rigid.setLinearVelocity(linear);
    b->rigid.setAngularVelocity(angular);
    if (!(rest == to)) {
      ReleaseParted(b);
      b->rigid.setWorldTransform(to);
      RefreshBox(b);
      broadphase_.Update(b, 2 * (to.getOrigin() - from.getOrigin()));
      broadphase_.Commit();
    }
    if (!b->moving) continue;
    for (Pair* p : b->pairs) {
      Body* other = p->Other(b);
      if (BoxesOverlap(*b, *other)) Wake(other);
    }
  }
}

// Components of bodies joined by overlapping exact boxes or by joints (L3). One whose awake members have all been still
// for long falls asleep; else its sleepers wake. Members of an island end up in ascending order of ids.
void BulletWorld::FindIslands() {
  ++step_;
  islands_ = 0;
  woken_.clear();
  if (awake_unsorted_) std::sort(awake_.begin(), awake_.end(), ById);
  for (Body* b : awake_) {
    if (b->visited != step_) Flood(b);
  }
  std::erase_if(awake_, [](const Body* b) { return b->asleep; });
  awake_unsorted_ = false;
  if (!woken_.empty()) {
    awake_.insert(awake_.end(), woken_.begin(), woken_.end());
    std::sort(awake_.begin(), awake_.end(), ById);
  }
  island_begin_.assign(static_cast<size_t>(islands_) + 1, 0);
  for (const Body* b : awake_) ++island_begin_[static_cast<size_t>(b->island)];
  size_t end = 0;
  for (size_t& begin : island_begin_) begin = end += begin;  // now the end of each island
  ordered_.resize(awake_.size());
  for (size_t i = awake_.size(); i-- > 0;) {
    ordered_[--island_begin_[static_cast<size_t>(awake_[i]->island)]] = awake_[i];
  }
}

void BulletWorld::Flood(Body* seed) {
  members_.assign(1, seed);
  seed->visited = step_;
  bool restless = false;
  const auto reach = [this](Body* other) {
    if (other->visited == step_) return;
    other->visited = step_;
    members_.push_back(other);
  };
  for (size_t i = 0; i < members_.size(); ++i) {
    Body* b = members_[i];
    restless = restless || (!b->asleep && b->still < sleep_ticks_);
    for (Pair* p : b->pairs) {
      Body* other = p->Other(b);
      if (other->dynamic() && BoxesOverlap(*b, *other)) reach(other);
    }
    for (Joint* j : b->joints) {
      if (Body* other = j->Other(b)) reach(other);
    }
  }
  for (Body* b : members_) {
    b->island = restless ? islands_ : -1;
    if (restless && b->asleep) {
      NoLongerAsleep(b);
      woken_.push_back(b);
    } else if (!restless && !b->asleep) {
      FallAsleep(b);
    }
  }
  if (restless) ++islands_;
}

void BulletWorld::SolveIsland(std::span<Body*> bodies) {
  solver_bodies_.clear();
  island_joints_.clear();
  for (Body* b : bodies) {
    b->rigid.applyGravity();
    b->rigid.setLinearVelocity(b->rigid.getLinearVelocity() * b->linear_keep);
    b->rigid.setAngularVelocity(b->rigid.getAngularVelocity() * b->angular_keep);
    solver_bodies_.push_back(&b->rigid);
    for (Joint* j : b->joints) {
      if (j->a == b) island_joints_.push_back(j);
    }
  }
  FindContacts(bodies);
  AddPredictiveContacts(bodies);
  std::sort(island_joints_.begin(), island_joints_.end(),
            [](const Joint* x, const Joint* y) { return x->spec.id < y->spec.id; });
  solver_joints_.clear();
  for (Joint* j : island_joints_) solver_joints_.push_back(j->constraint.get());

  solver_.solveGroup(solver_bodies_.data(), static_cast<int>(solver_bodies_.size()), solver_manifolds_.data(),
                     static_cast<int>(solver_manifolds_.size()), solver_joints_.data(),
                     static_cast<int>(solver_joints_.size()), solver_info_, nullptr, contacts_.dispatcher());

  for (btPersistentManifold* m : predictive_) contacts_.dispatcher()->releaseManifold(m);
  Integrate(bodies);
}

// The manifolds of the island in an order that only its bodies decide (L4): by the dynamic body with the smaller id,
// then by the other body, then by their parts.
void BulletWorld::FindContacts(std::span<Body*> bodies) {
  solver_manifolds_.clear();
  for (Body* b : bodies) {
    rows_.clear();
    for (Pair* p : b->pairs) {
      Body* other = p->Other(b);
      if (other->dynamic() && other->id < b->id) continue;
      if (!BoxesOverlap(*b, *other) || !MayCollide(*b, *other)) {
        contacts_.Release(*p);
        continue;
      }
      found_.clear();
      contacts_.Find(*p, &found_);
      for (const Manifold& m : found_) rows_.push_back({other->id, m});
    }
    if (rows_.size() > 1) {
      std::sort(rows_.begin(), rows_.end(), [](const Row& x, const Row& y) {
        return std::tie(x.other, x.manifold.part_a, x.manifold.part_b) <
               std::tie(y.other, y.manifold.part_a, y.manifold.part_b);
      });
    }
    for (const Row& row : rows_) solver_manifolds_.push_back(row.manifold.points);
  }
}

// A fast body gets one contact ahead, with what its sweep meets first, so that the solver slows it down to arrive there
// instead of beyond it. These contacts live for this tick only.
void BulletWorld::AddPredictiveContacts(std::span<Body*> bodies) {
  predictive_.clear();
  for (Body* b : bodies) {
    if (!b->ccd || !MovesFast(*b, (b->rigid.getLinearVelocity() * dt_).length2())) continue;
    SweepHit hit;
    if (!Sweep(*b, b->rigid.getLinearVelocity() * dt_, dt_, &hit)) continue;
    const btVector3& here = b->rigid.getWorldTransform().getOrigin();
    const btVector3 there = here + hit.way;
    btManifoldPoint point(btVector3(0, 0, 0), hit.other->rigid.getWorldTransform().inverse() * there, hit.normal,
                          hit.way.dot(-hit.normal));
    btPersistentManifold* manifold = contacts_.dispatcher()->getNewManifold(&b->rigid, &hit.other->rigid);
    btManifoldPoint& added = manifold->getContactPoint(manifold->addManifoldPoint(point, true));
    added.m_combinedFriction = btManifoldResult::calculateCombinedFriction(&b->rigid, &hit.other->rigid);
    added.m_positionWorldOnA = here;
    added.m_positionWorldOnB = there;
    predictive_.push_back(manifold);
    solver_manifolds_.push_back(manifold);
  }
}

// Sweeps come first, so that none of them sees a body that has already moved (L7).
void BulletWorld::Integrate(std::span<Body*> bodies) {
  targets_.resize(bodies.size());
  for (size_t i = 0; i < bodies.size(); ++i) {
    Body* b = bodies[i];
    b->rigid.setLinearVelocity(Clamped(b->rigid.getLinearVelocity()));
    b->rigid.setAngularVelocity(ClampedSpin(b->rigid.getAngularVelocity()));
    b->rigid.predictIntegratedTransform(dt_, targets_[i]);
    if (!b->ccd || !MovesFast(*b, (b->rigid.getLinearVelocity() * dt_).length2())) continue;
    SweepHit hit;
    if (Sweep(*b, b->rigid.getLinearVelocity() * dt_, dt_, &hit))
      b->rigid.predictIntegratedTransform(dt_ * hit.fraction, targets_[i]);
  }
  for (size_t i = 0; i < bodies.size(); ++i) {
    bodies[i]->rigid.proceedToTransform(targets_[i]);
    bodies[i]->rigid.clearForces();
  }
}

// After all islands: the sleep timers, and the boxes that the next tick will use.
void BulletWorld::Settle() {
  const double linear2 = environment_.sleep_linear * environment_.sleep_linear;
  const double angular2 = environment_.sleep_angular * environment_.sleep_angular;
  for (Body* b : awake_) {
    const bool still =
        b->rigid.getLinearVelocity().length2() < linear2 && b->rigid.getAngularVelocity().length2() < angular2;
    b->still = still ? std::min(b->still + 1, sleep_ticks_) : 0;
    RefreshBox(b);
    if (b->swept > 0) max_radius_ = std::max(max_radius_, Radius(*b));
    broadphase_.Update(b, b->rigid.getLinearVelocity() * (2 * dt_));
  }
  broadphase_.Commit();
  broadphase_.Rebalance();
}

}  // namespace aureole::physics
