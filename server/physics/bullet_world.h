// Rigid bodies on Bullet's shapes, contact algorithms and solver, with a step of our own: islands, sleep, integration
// and every order are ours. The step solves one contact component at a time, each from its own state only; that, with
// the rules of EXACT.md, is what makes a split world exact.
//
// Differences to btDiscreteDynamicsWorld: pairs, islands and contacts are decided by exact boxes; islands are found and
// woken before the contacts are refreshed; sleeping bodies are in no loop; sweeps see all bodies where they were at the
// start of the tick; a kinematic body wakes others only in ticks in which it moves.
#pragma once

#include <map>
#include <memory>
#include <span>
#include <vector>

#include <absl/container/flat_hash_map.h>

#include "server/core/engine.h"
#include "server/physics/body.h"
#include "server/physics/broadphase.h"
#include "server/physics/contacts.h"

namespace aureole::physics {

// All that decides a dynamic body's future, contacts and joints apart.
struct BodyState {
  BodyId id = 0;
  std::shared_ptr<const CollisionShape> shape;
  double mass = 1;
  Material material;
  bool ccd = false;
  btTransform pose;
  btVector3 velocity, angular_velocity;
  bool asleep = false;
  uint32_t still = 0;
};

// What engines of one world share: the environment, and all shapes.
struct Surroundings {
  explicit Surroundings(const Environment& e) : environment(e) {
    for (const BodySpec& spec : environment.fixed) fixed_shapes.push_back(shapes.Get(spec.shape));
  }
  const Environment environment;
  ShapeCache shapes;
  std::vector<std::shared_ptr<const CollisionShape>> fixed_shapes;  // of environment.fixed
};

class BulletWorld {
 public:
  // `pool`: contact manifolds to keep room for.
  BulletWorld(std::shared_ptr<Surroundings> surroundings, int pool);
  ~BulletWorld();

  Body* Find(BodyId id) const;  // dynamic; null if not here
  Body* FindAny(BodyId id) const;
  const absl::flat_hash_map<BodyId, std::unique_ptr<Body>>& bodies() const { return bodies_; }
  const std::map<JointId, std::unique_ptr<Joint>>& joints() const { return joints_; }
  const std::vector<Body*>& awake() const { return awake_; }
  const std::shared_ptr<Surroundings>& surroundings() const { return surroundings_; }
  Tick tick() const { return tick_; }
  Contacts& contacts() { return contacts_; }
  const Contacts& contacts() const { return contacts_; }
  const Broadphase& broadphase() const { return broadphase_; }
  double max_radius() const { return max_radius_; }
  double Radius(const Body& body) const { return (body.shape->reach + kBreakingMargin + body.swept) * (1 + 1e-12); }

  Body* Add(const BodyState& state);
  void AddJoint(const JointSpec& spec);
  BodyState StateOf(const BodySpec& spec) const;
  BodyState StateOf(const Body& body) const;
  // Removes the body and its joints, waking nobody.
  void Remove(Body* body);
  // Wakes what the body touches and its joint partners (P59).
  void WakeNeighbours(Body* body);
  void Wake(Body* body);
  // A change from outside; wakes the body.
  void SetVelocities(Body* body, const btVector3& velocity, const btVector3& angular_velocity);

  // From here on, bodies that fall asleep are noted; and those noted since the last call, appended.
  void NoteSleep(bool on);
  void TakeSleep(std::vector<BodyId>* slept, std::vector<BodyId>* woke);

  void Step(Tick n);
  // Puts the kinematic bodies where they are after tick n. For a world without dynamic bodies.
  void SetTick(Tick n);
  // Whether a kinematic body has a script.
  bool scripted() const { return scripted_; }

  // Sleeping bodies outside the rectangle shrunk by the margin, from a list that is kept up to date.
  const std::vector<Body*>& SleepersOutside(const Rect& rect, double margin) const;

 private:
  // bullet_world.cc
  void AddFixed(const BodySpec& spec, const std::shared_ptr<const CollisionShape>& shape);
  void ReleaseParted(Body* body);
  void RefreshBox(Body* body) const;
  btVector3 Clamped(const btVector3& velocity) const;  // to the speed limit, and kMostSpeed
  btVector3 ClampedSpin(const btVector3& angular_velocity) const;
  void FallAsleep(Body* body);
  void NoLongerAsleep(Body* body);
  void NoteSleeper(Body* body) const;
  void ForgetSleeper(Body* body) const;
  // bullet_step.cc
  void MoveKinematic(Tick n);
  void FindIslands();
  void Flood(Body* seed);
  void SolveIsland(std::span<Body*> bodies);
  void FindContacts(std::span<Body*> bodies);
  void AddPredictiveContacts(std::span<Body*> bodies);
  void Integrate(std::span<Body*> bodies);
  void Settle();

  const std::shared_ptr<Surroundings> surroundings_;
  const Environment& environment_;
  const double dt_;
  const btVector3 gravity_;
  const uint32_t sleep_ticks_;
  Tick tick_ = 0;
  Contacts contacts_;
  Broadphase broadphase_;
  btSequentialImpulseConstraintSolver solver_;
  btContactSolverInfo solver_info_;
  btRigidBody anchor_;  // what joints to the world hold on to
  absl::flat_hash_map<BodyId, std::unique_ptr<Body>> bodies_;
  absl::flat_hash_map<BodyId, std::unique_ptr<Body>> fixed_;
  std::vector<Body*> kinematic_;  // ascending ids
  bool scripted_ = false;
  std::map<JointId, std::unique_ptr<Joint>> joints_;
  std::vector<Body*> awake_;  // all dynamic bodies that are not asleep; ascending ids unless awake_unsorted_
  bool awake_unsorted_ = false;
  double max_radius_ = 0;
  bool note_sleep_ = false;
  std::vector<BodyId> slept_, woke_;

  // The rectangle that SleepersOutside was last asked for, and its answer.
  mutable Rect outside_of_;
  mutable double outside_margin_ = -1;
  mutable std::vector<Body*> outside_;

  // Of the current step.
  struct Row {
    BodyId other = 0;
    Manifold manifold;
  };
  uint64_t step_ = 0;
  int islands_ = 0;
  std::vector<Body*> members_, woken_, ordered_;
  std::vector<size_t> island_begin_;
  std::vector<Row> rows_;
  std::vector<Manifold> found_;
  std::vector<btCollisionObject*> solver_bodies_;
  std::vector<btPersistentManifold*> solver_manifolds_;
  std::vector<btPersistentManifold*> predictive_;
  std::vector<Joint*> island_joints_;
  std::vector<btTypedConstraint*> solver_joints_;
  std::vector<btTransform> targets_;
};

}  // namespace aureole::physics
