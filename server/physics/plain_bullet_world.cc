#include "server/physics/plain_bullet_world.h"

#include "server/physics/bullet.h"
#include "server/physics/script_pose.h"
#include "server/physics/shapes.h"

namespace aureole {

using physics::CollisionShape;
using physics::PoseAt;
using physics::ShapeCache;
using physics::ToBullet;

struct PlainBulletWorld::Impl {
  explicit Impl(const Environment& e)
      : environment(e), dispatcher(&configuration), world(&dispatcher, &broadphase, &solver, &configuration) {
    world.setGravity(ToBullet(e.gravity));
    world.getSolverInfo().m_numIterations = e.iterations;
    for (const BodySpec& spec : e.fixed) Add(spec);
  }
  ~Impl() {
    for (auto& body : bodies) world.removeRigidBody(body.get());
  }

  void Add(const BodySpec& spec) {
    shapes.push_back(cache.Get(spec.shape));
    btCollisionShape* shape = shapes.back()->whole;
    const double mass = spec.motion == Motion::kDynamic ? spec.mass : 0;
    btVector3 inertia(0, 0, 0);
    if (mass > 0) shape->calculateLocalInertia(mass, inertia);
    btRigidBody::btRigidBodyConstructionInfo info(mass, nullptr, shape, inertia);
    info.m_startWorldTransform = ToBullet(spec.orientation, spec.position);
    info.m_friction = spec.material.friction;
    info.m_rollingFriction = spec.material.rolling_friction;
    info.m_spinningFriction = spec.material.spinning_friction;
    info.m_restitution = spec.material.restitution;
    info.m_linearDamping = spec.material.linear_damping;
    info.m_angularDamping = spec.material.angular_damping;
    bodies.push_back(std::make_unique<btRigidBody>(info));
    btRigidBody* body = bodies.back().get();
    body->setLinearVelocity(ToBullet(spec.velocity));
    body->setAngularVelocity(ToBullet(spec.angular_velocity));
    if (environment.sleep_linear <= 0) body->setActivationState(DISABLE_DEACTIVATION);
    if (spec.motion == Motion::kKinematic) {
      body->setCollisionFlags(btCollisionObject::CF_KINEMATIC_OBJECT);
      body->setActivationState(DISABLE_DEACTIVATION);
      if (spec.script != nullptr) movers.push_back({body, spec.script});
    }
    world.addRigidBody(body);
  }

  const Environment environment;
  ShapeCache cache;
  std::vector<std::shared_ptr<const CollisionShape>> shapes;
  btDefaultCollisionConfiguration configuration;
  btCollisionDispatcher dispatcher;
  btDbvtBroadphase broadphase;
  btSequentialImpulseConstraintSolver solver;
  btDiscreteDynamicsWorld world;
  std::vector<std::unique_ptr<btRigidBody>> bodies;
  std::vector<std::pair<btRigidBody*, std::shared_ptr<const Script>>> movers;
};

PlainBulletWorld::PlainBulletWorld(const Environment& environment) : impl_(std::make_unique<Impl>(environment)) {}
PlainBulletWorld::~PlainBulletWorld() = default;

void PlainBulletWorld::Spawn(const BodySpec& body) { impl_->Add(body); }

void PlainBulletWorld::Step(Tick n) {
  const double dt = impl_->environment.dt();
  for (auto& [body, script] : impl_->movers) {
    body->setWorldTransform(PoseAt(*script, static_cast<double>(n) * dt, body->getWorldTransform()));
  }
  impl_->world.stepSimulation(dt, 0);
}

int64_t PlainBulletWorld::CountContacts() const {
  int64_t points = 0;
  for (int i = 0; i < impl_->dispatcher.getNumManifolds(); ++i) {
    points += impl_->dispatcher.getManifoldByIndexInternal(i)->getNumContacts();
  }
  return points;
}

}  // namespace aureole
