#include "server/physics/bullet_engine.h"

#include <algorithm>
#include <bit>
#include <utility>

#include "server/core/check.h"
#include "server/physics/bullet_world.h"
#include "server/physics/state.h"

namespace aureole {
namespace physics {
namespace {

constexpr int kPool = 4096;        // manifolds of a region
constexpr int kScratchPool = 128;  // of a cluster on its own

// From the centre of mass to where the impulse acts, in the world's frame.
btVector3 Lever(const Input& input, const btRigidBody& rigid) {
  switch (input.frame) {
    case Input::Frame::kCentre:
      break;
    case Input::Frame::kWorld:
      return ToBullet(input.point) - rigid.getWorldTransform().getOrigin();
    case Input::Frame::kBody:
      return rigid.getWorldTransform().getBasis() * ToBullet(input.point);
  }
  return btVector3(0, 0, 0);
}

void PrefetchPose(const Body& body) {
  const btTransform& at = body.rigid.getWorldTransform();
  __builtin_prefetch(&at);
  __builtin_prefetch(&at.getBasis()[2]);
  __builtin_prefetch(&at.getOrigin());
  __builtin_prefetch(&body.rigid.getLinearVelocity());
  __builtin_prefetch(&body.rigid.getAngularVelocity());
  __builtin_prefetch(&body.asleep);
}

BodyPose PoseOf(const Body& body) {
  const btTransform& at = body.rigid.getWorldTransform();
  const btQuaternion turn = at.getRotation();
  return {body.id,
          FromBullet(at.getOrigin()),
          Quat(turn.w(), turn.x(), turn.y(), turn.z()),
          FromBullet(body.rigid.getLinearVelocity()),
          FromBullet(body.rigid.getAngularVelocity()),
          body.asleep};
}

bool ById(const BodyPose& x, const BodyPose& y) { return x.id < y.id; }

class BulletEngine : public Engine {
 public:
  BulletEngine(std::shared_ptr<Surroundings> surroundings, int pool) : world_(std::move(surroundings), pool) {}

  void Spawn(const BodySpec& body) override { world_.Add(world_.StateOf(body)); }
  void Join(const JointSpec& joint) override { world_.AddJoint(joint); }
  void Apply(const Input& input) override;
  void Step(Tick n) override { world_.Step(n); }

  bool Contains(BodyId id) const override { return world_.Find(id) != nullptr; }
  BodyView View(BodyId id) const override;
  BodyPose Pose(BodyId id) const override;
  BodyLook Look(BodyId id) const override;
  uint64_t Hash(BodyId id) const override;
  void Jointed(BodyId id, std::vector<BodyId>* out) const override;

  std::vector<BodyId> Ids() const override;
  void CollectOutside(const Rect& interior, double margin, std::vector<BodyId>* out) const override;
  void Query(const Box& box, std::vector<BodyId>* out) const override;
  void AppendAwake(std::vector<BodyPose>* out) const override;
  void AppendPoses(const Box& box, std::vector<BodyPose>* out) const override;
  int64_t CountAwake() const override { return static_cast<int64_t>(world_.awake().size()); }
  std::optional<RayHit> CastRay(const Vec3& from, const Vec3& to) const override;
  void NoteSleep(bool on) override { world_.NoteSleep(on); }
  void TakeSleep(std::vector<BodyId>* slept, std::vector<BodyId>* woke) override { world_.TakeSleep(slept, woke); }
  double MaxRadius() const override { return world_.max_radius(); }

  void SaveTo(std::span<const BodyId> ids, std::string* out) const override;
  std::string Extract(std::span<const BodyId> ids) override;
  absl::Status Restore(std::string_view state) override { return RestoreState(state, &world_); }
  std::unique_ptr<Engine> Scratch() const override {
    return std::make_unique<BulletEngine>(world_.surroundings(), kScratchPool);
  }

  EngineCounts Counts() const override {
    return {static_cast<int64_t>(world_.bodies().size()), static_cast<int64_t>(world_.awake().size()),
            world_.contacts().CountPoints()};
  }

 private:
  Body* Get(BodyId id) const;

  BulletWorld world_;
};

Body* BulletEngine::Get(BodyId id) const {
  Body* body = world_.Find(id);
  AUREOLE_CHECK(body != nullptr, "body %llu is not here", static_cast<unsigned long long>(id));
  return body;
}

void BulletEngine::Apply(const Input& input) {
  if (input.kind == Input::Kind::kSpawn) {
    Spawn(*input.spawn);
    return;
  }
  Body* body = Get(input.body);
  const btRigidBody& rigid = body->rigid;
  const btVector3 linear = ToBullet(input.linear), angular = ToBullet(input.angular);
  switch (input.kind) {
    case Input::Kind::kSpawn:
    case Input::Kind::kLayout:
      break;
    case Input::Kind::kRemove:
      world_.WakeNeighbours(body);
      world_.Remove(body);
      break;
    case Input::Kind::kImpulse: {
      const btVector3 moment = angular + Lever(input, rigid).cross(linear);
      world_.SetVelocities(body, rigid.getLinearVelocity() + linear * rigid.getInvMass(),
                           rigid.getAngularVelocity() + rigid.getInvInertiaTensorWorld() * moment);
      break;
    }
    case Input::Kind::kVelocity:
      world_.SetVelocities(body, linear, angular);
      break;
    case Input::Kind::kVelocityChange:
      world_.SetVelocities(body, rigid.getLinearVelocity() + linear, rigid.getAngularVelocity() + angular);
      break;
  }
}

BodyView BulletEngine::View(BodyId id) const {
  const Body& body = *Get(id);
  BodyView view;
  view.id = id;
  view.box = {FromBullet(body.low), FromBullet(body.high)};
  view.centre = FromBullet(body.rigid.getWorldTransform().getOrigin());
  view.radius = world_.Radius(body);
  view.velocity = FromBullet(body.rigid.getLinearVelocity());
  view.mass = body.mass;
  const btVector3 inertia = body.rigid.getLocalInertia();
  view.least_inertia = inertia[inertia.minAxis()];
  view.asleep = body.asleep;
  if (!body.asleep) {
    const btVector3 turning = body.rigid.getAngularVelocity() * body.rigid.getWorldTransform().getBasis();
    const btVector3 spin = turning * body.rigid.getLocalInertia();
    view.energy = 0.5 * body.mass * view.velocity.squaredNorm() + 0.5 * turning.dot(spin);
  }
  return view;
}

BodyPose BulletEngine::Pose(BodyId id) const { return PoseOf(*Get(id)); }

BodyLook BulletEngine::Look(BodyId id) const {
  const Body& body = *Get(id);
  return {body.shape->source, body.mass, body.material};
}

void BulletEngine::AppendAwake(std::vector<BodyPose>* out) const {
  const auto first = static_cast<std::ptrdiff_t>(out->size());
  bool ascending = true;
  BodyId last = 0;
  for (const Body* b : world_.awake()) {
    ascending &= last < b->id;
    last = b->id;
    out->push_back(PoseOf(*b));
  }
  if (!ascending) std::sort(out->begin() + first, out->end(), ById);
}

void BulletEngine::AppendPoses(const Box& box, std::vector<BodyPose>* out) const {
  std::vector<const Body*> found;
  world_.broadphase().Query(ToBullet(box.min), ToBullet(box.max), [&found](const Body* b) { found.push_back(b); });
  std::sort(found.begin(), found.end(), [](const Body* x, const Body* y) { return x->id < y->id; });
  constexpr size_t kAhead = 4;
  for (size_t i = 0; i < found.size(); ++i) {
    if (i + kAhead < found.size()) PrefetchPose(*found[i + kAhead]);
    out->push_back(PoseOf(*found[i]));
  }
}

std::optional<RayHit> BulletEngine::CastRay(const Vec3& from, const Vec3& to) const {
  const btVector3 begin = ToBullet(from), end = ToBullet(to);
  const btTransform first(btQuaternion::getIdentity(), begin), last(btQuaternion::getIdentity(), end);
  btCollisionWorld::ClosestRayResultCallback nearest(begin, end);
  world_.broadphase().ForEachOnRay(begin, end, [&](Body* b) {
    btCollisionWorld::rayTestSingle(first, last, &b->rigid, b->rigid.getCollisionShape(), b->rigid.getWorldTransform(),
                                    nearest);
  });
  if (!nearest.hasHit()) return std::nullopt;
  const auto* body = static_cast<const Body*>(nearest.m_collisionObject->getUserPointer());
  return RayHit{body->id, !body->dynamic(), nearest.m_closestHitFraction,
                FromBullet(nearest.m_hitNormalWorld).normalized()};
}

uint64_t BulletEngine::Hash(BodyId id) const {
  const Body& body = *Get(id);
  uint64_t hash = id;
  const auto mix = [&hash](uint64_t word) {
    hash = (hash ^ word) * 0x9fb21c651e98df25;
    hash ^= hash >> 32;
  };
  const auto mix_vector = [&mix](const btVector3& v) {
    for (int i = 0; i < 3; ++i) mix(std::bit_cast<uint64_t>(v[i]));
  };
  for (int i = 0; i < 3; ++i) mix_vector(body.rigid.getWorldTransform().getBasis()[i]);
  mix_vector(body.rigid.getWorldTransform().getOrigin());
  mix_vector(body.rigid.getLinearVelocity());
  mix_vector(body.rigid.getAngularVelocity());
  mix(body.still * uint64_t{2} + (body.asleep ? 1 : 0));
  return hash;
}

void BulletEngine::Jointed(BodyId id, std::vector<BodyId>* out) const {
  const Body* body = Get(id);
  const auto first = static_cast<std::ptrdiff_t>(out->size());
  for (const Joint* j : body->joints) {
    if (const Body* other = j->Other(body)) out->push_back(other->id);
  }
  std::sort(out->begin() + first, out->end());
  out->erase(std::unique(out->begin() + first, out->end()), out->end());
}

std::vector<BodyId> BulletEngine::Ids() const {
  std::vector<BodyId> ids;
  ids.reserve(world_.bodies().size());
  for (const auto& [id, body] : world_.bodies()) ids.push_back(id);
  std::sort(ids.begin(), ids.end());
  return ids;
}

void BulletEngine::CollectOutside(const Rect& interior, double margin, std::vector<BodyId>* out) const {
  const auto first = static_cast<std::ptrdiff_t>(out->size());
  for (const Body* b : world_.SleepersOutside(interior, margin)) out->push_back(b->id);
  for (const Body* b : world_.awake()) {
    if (!interior.Encloses({FromBullet(b->low), FromBullet(b->high)}, margin)) out->push_back(b->id);
  }
  std::sort(out->begin() + first, out->end());
}

void BulletEngine::Query(const Box& box, std::vector<BodyId>* out) const {
  const auto first = static_cast<std::ptrdiff_t>(out->size());
  world_.broadphase().Query(ToBullet(box.min), ToBullet(box.max), [out](const Body* b) { out->push_back(b->id); });
  std::sort(out->begin() + first, out->end());
}

void BulletEngine::SaveTo(std::span<const BodyId> ids, std::string* out) const {
  for (BodyId id : ids) Get(id);
  SaveState(world_, ids, out);
}

std::string BulletEngine::Extract(std::span<const BodyId> ids) {
  std::string state = Save(ids);
  for (BodyId id : ids) world_.Remove(world_.Find(id));
  return state;
}

}  // namespace

std::unique_ptr<Engine> MakeEngine(const Environment& environment) {
  return std::make_unique<BulletEngine>(std::make_shared<Surroundings>(environment), kPool);
}

}  // namespace physics

std::unique_ptr<Engine> MakeBulletEngine(const Environment& environment) { return physics::MakeEngine(environment); }

}  // namespace aureole
