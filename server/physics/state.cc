#include "server/physics/state.h"

#include <algorithm>
#include <cmath>
#include <tuple>

#include <absl/container/flat_hash_map.h>
#include <absl/container/flat_hash_set.h>
#include <absl/strings/str_cat.h>

#include "server/core/check.h"
#include "server/physics/bytes.h"
#include "server/physics/codec.h"

namespace aureole::physics {
namespace {

constexpr uint32_t kMagic = 0x74536541;  // "AeSt"
constexpr uint32_t kVersion = 1;

struct ManifoldState {
  BodyId a = 0, b = 0;
  uint32_t part_a = 0, part_b = 0;
  std::vector<btManifoldPoint> points;
};

struct State {
  Tick tick = 0;
  std::vector<BodyState> bodies;
  std::vector<JointSpec> joints;
  std::vector<ManifoldState> manifolds;
};

void PutVector(const btVector3& v, ByteWriter* out) {
  for (int i = 0; i < 3; ++i) out->Put(v[i]);
}
btVector3 GetVector(double bound, ByteReader* in) {
  btVector3 v(0, 0, 0);
  for (int i = 0; i < 3; ++i) v[i] = in->GetFinite(bound);
  return v;
}

void PutPoint(const btManifoldPoint& p, ByteWriter* out) {
  for (const btVector3& v : {p.m_localPointA, p.m_localPointB, p.m_positionWorldOnA, p.m_positionWorldOnB,
                             p.m_normalWorldOnB, p.m_lateralFrictionDir1, p.m_lateralFrictionDir2}) {
    PutVector(v, out);
  }
  for (double x : {p.m_distance1, p.m_combinedFriction, p.m_combinedRollingFriction, p.m_combinedSpinningFriction,
                   p.m_combinedRestitution, p.m_appliedImpulse, p.m_prevRHS, p.m_appliedImpulseLateral1,
                   p.m_appliedImpulseLateral2, p.m_contactMotion1, p.m_contactMotion2, p.m_contactCFM, p.m_contactERP,
                   p.m_frictionCFM}) {
    out->Put(x);
  }
  for (int i : {p.m_partId0, p.m_partId1, p.m_index0, p.m_index1, p.m_contactPointFlags, p.m_lifeTime}) out->Put(i);
}

btManifoldPoint GetPoint(ByteReader* in) {
  btManifoldPoint p(btVector3(0, 0, 0), btVector3(0, 0, 0), btVector3(0, 0, 0), 0);
  for (btVector3* v : {&p.m_localPointA, &p.m_localPointB, &p.m_positionWorldOnA, &p.m_positionWorldOnB}) {
    *v = GetVector(kMaxPosition, in);
  }
  for (btVector3* v : {&p.m_normalWorldOnB, &p.m_lateralFrictionDir1, &p.m_lateralFrictionDir2}) {
    *v = GetVector(1.001, in);
  }
  if (std::abs(p.m_normalWorldOnB.length2() - 1) > 1e-3) in->Fail();
  for (double* x : {&p.m_distance1, &p.m_combinedFriction, &p.m_combinedRollingFriction, &p.m_combinedSpinningFriction,
                    &p.m_combinedRestitution, &p.m_appliedImpulse, &p.m_prevRHS, &p.m_appliedImpulseLateral1,
                    &p.m_appliedImpulseLateral2, &p.m_contactMotion1, &p.m_contactMotion2, &p.m_contactCFM,
                    &p.m_contactERP, &p.m_frictionCFM}) {
    *x = in->GetFinite(kMaxQuantity);
  }
  for (int* i : {&p.m_partId0, &p.m_partId1, &p.m_index0, &p.m_index1, &p.m_contactPointFlags, &p.m_lifeTime}) {
    *i = in->Get<int>();
    if (*i < -1) in->Fail();
  }
  if ((p.m_contactPointFlags & ~BT_CONTACT_FLAG_LATERAL_FRICTION_INITIALIZED) != 0) in->Fail();
  return p;
}

// A rotation, within rounding.
btMatrix3x3 GetBasis(ByteReader* in) {
  btMatrix3x3 m;
  for (int i = 0; i < 3; ++i) m[i] = GetVector(1.001, in);
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      if (!(std::abs(m[i].dot(m[j]) - (i == j ? 1 : 0)) < 1e-6)) in->Fail();
    }
  }
  if (!(m.determinant() > 0)) in->Fail();
  return m;
}

void PutBody(const BodyState& s, uint32_t shape, ByteWriter* out) {
  out->Put(s.id);
  out->Put(shape);
  out->Put(s.mass);
  PutMaterial(s.material, out);
  out->Put(static_cast<uint8_t>((s.ccd ? 1 : 0) + (s.asleep ? 2 : 0)));
  out->Put(s.still);
  for (int i = 0; i < 3; ++i) PutVector(s.pose.getBasis()[i], out);
  PutVector(s.pose.getOrigin(), out);
  PutVector(s.velocity, out);
  PutVector(s.angular_velocity, out);
}

BodyState GetBody(const std::vector<std::shared_ptr<const CollisionShape>>& shapes, ByteReader* in) {
  BodyState s;
  s.id = in->Get<uint64_t>();
  const uint32_t shape = in->Get<uint32_t>();
  if (shape < shapes.size()) {
    s.shape = shapes[shape];
  } else {
    in->Fail();
  }
  s.mass = in->GetFinite(kMaxMass);
  if (s.mass < kMinMass || s.id == 0) in->Fail();
  s.material = GetMaterial(in);
  const uint8_t flags = in->Get<uint8_t>();
  if (flags > 3) in->Fail();
  s.ccd = (flags & 1) != 0;
  s.asleep = (flags & 2) != 0;
  s.still = in->Get<uint32_t>();
  s.pose.setBasis(GetBasis(in));
  s.pose.setOrigin(GetVector(kMaxPosition, in));
  s.velocity = GetVector(kMaxVelocity, in);
  s.angular_velocity = GetVector(kMaxVelocity, in);
  if (s.asleep && (s.still != 0 || !s.velocity.isZero() || !s.angular_velocity.isZero())) in->Fail();
  return s;
}

bool Parse(std::string_view bytes, ShapeCache* cache, State* out) {
  ByteReader in(bytes);
  if (in.Get<uint32_t>() != kMagic || in.Get<uint32_t>() != kVersion) return false;
  out->tick = in.Get<int64_t>();
  std::vector<std::shared_ptr<const CollisionShape>> shapes(in.GetCount(sizeof(uint32_t)));
  for (auto& shape : shapes) {
    shape = cache->GetDynamic(in.GetString());
    if (shape == nullptr) return false;
  }
  for (uint32_t n = in.GetCount(200); n > 0 && in.ok(); --n) {
    out->bodies.push_back(GetBody(shapes, &in));
    if (out->bodies.size() > 1 && out->bodies[out->bodies.size() - 2].id >= out->bodies.back().id) return false;
  }
  for (uint32_t n = in.GetCount(100); n > 0 && in.ok(); --n) {
    out->joints.push_back(GetJoint(&in));
    if (out->joints.size() > 1 && out->joints[out->joints.size() - 2].id >= out->joints.back().id) return false;
  }
  for (uint32_t n = in.GetCount(100); n > 0 && in.ok(); --n) {
    ManifoldState& m = out->manifolds.emplace_back();
    m.a = in.Get<uint64_t>();
    m.b = in.Get<uint64_t>();
    m.part_a = in.Get<uint32_t>();
    m.part_b = in.Get<uint32_t>();
    const uint8_t points = in.Get<uint8_t>();
    if (m.a >= m.b || points == 0 || points > MANIFOLD_CACHE_SIZE) return false;
    for (int i = 0; i < points; ++i) m.points.push_back(GetPoint(&in));
    if (out->manifolds.size() > 1) {
      const ManifoldState& before = out->manifolds[out->manifolds.size() - 2];
      if (std::tie(before.a, before.b, before.part_a, before.part_b) >= std::tie(m.a, m.b, m.part_a, m.part_b)) {
        return false;
      }
    }
  }
  return in.done();
}

// What can be said before anything is changed.
absl::Status Check(const State& state, const BulletWorld& world) {
  const auto invalid = [](auto&&... parts) { return absl::InvalidArgumentError(absl::StrCat("state: ", parts...)); };
  if (state.tick != world.tick() && world.scripted() && !world.bodies().empty()) {
    return invalid("is of tick ", state.tick, ", this engine is at ", world.tick());
  }
  absl::flat_hash_map<BodyId, const CollisionShape*> shapes;
  for (const BodyState& b : state.bodies) {
    if (world.FindAny(b.id) != nullptr) return invalid("body ", b.id, " is already here");
    shapes[b.id] = b.shape.get();
  }
  for (const JointSpec& j : state.joints) {
    if (world.joints().contains(j.id)) return invalid("joint ", j.id, " is already here");
    if (!shapes.contains(j.a) || (j.b != 0 && !shapes.contains(j.b))) return invalid("joint ", j.id, " lacks a body");
  }
  for (const ManifoldState& m : state.manifolds) {
    bool dynamic = false;
    for (auto [id, part] : {std::pair(m.a, m.part_a), std::pair(m.b, m.part_b)}) {
      const auto it = shapes.find(id);
      dynamic = dynamic || it != shapes.end();
      const Body* fixed = it == shapes.end() && world.Find(id) == nullptr ? world.FindAny(id) : nullptr;
      const CollisionShape* shape = it != shapes.end() ? it->second : fixed != nullptr ? fixed->shape.get() : nullptr;
      if (shape == nullptr) return invalid("contact with body ", id, ", which is neither in it nor fixed");
      if (part >= shape->parts.size()) return invalid("contact with part ", part, " of body ", id);
    }
    if (!dynamic) return invalid("contact of fixed bodies ", m.a, " and ", m.b);
  }
  return absl::OkStatus();
}

Pair* FindPair(const Body& a, const Body& b) {
  const Body& few = a.pairs.size() < b.pairs.size() ? a : b;
  const Body& many = &few == &a ? b : a;
  for (Pair* p : few.pairs) {
    if (p->Other(&few) == &many) return p;
  }
  return nullptr;
}

}  // namespace

void SaveState(const BulletWorld& world, std::span<const BodyId> ids, std::string* bytes) {
  std::vector<const Body*> bodies;
  absl::flat_hash_set<const Body*> chosen;
  for (BodyId id : ids) {
    bodies.push_back(world.Find(id));
    chosen.insert(bodies.back());
  }
  const auto need = [&](const Body* body, const Body* partner, const char* why) {
    AUREOLE_CHECK(partner == nullptr || !partner->dynamic() || chosen.contains(partner),
                  "body %llu is saved without its %s, body %llu", static_cast<unsigned long long>(body->id), why,
                  static_cast<unsigned long long>(partner->id));
  };

  ByteWriter out(bytes);
  out.Put(kMagic);
  out.Put(kVersion);
  out.Put(world.tick());
  absl::flat_hash_map<const CollisionShape*, uint32_t> index;
  std::vector<const CollisionShape*> shapes;
  for (const Body* b : bodies) {
    if (index.emplace(b->shape.get(), static_cast<uint32_t>(shapes.size())).second) shapes.push_back(b->shape.get());
  }
  out.Put(static_cast<uint32_t>(shapes.size()));
  for (const CollisionShape* s : shapes) out.PutString(s->bytes);
  out.Put(static_cast<uint32_t>(bodies.size()));
  for (const Body* b : bodies) PutBody(world.StateOf(*b), index[b->shape.get()], &out);

  std::vector<const JointSpec*> joints;
  for (const Body* b : bodies) {
    for (const Joint* j : b->joints) {
      need(b, j->Other(b), "joint partner");
      if (j->a == b) joints.push_back(&j->spec);
    }
  }
  std::sort(joints.begin(), joints.end(), [](const JointSpec* x, const JointSpec* y) { return x->id < y->id; });
  out.Put(static_cast<uint32_t>(joints.size()));
  for (const JointSpec* j : joints) PutJoint(*j, &out);

  struct Touching {
    BodyId a, b;
    Manifold manifold;
  };
  std::vector<Touching> touching;
  std::vector<Manifold> found;
  for (const Body* b : bodies) {
    for (const Pair* p : b->pairs) {
      const Body* other = p->Other(b);
      if (!BoxesOverlap(*p->a, *p->b)) continue;  // what they hold is about to be freed
      if (other->dynamic() && other->id < b->id && chosen.contains(other)) continue;  // once is enough
      found.clear();
      world.contacts().List(*p, &found);
      if (!found.empty()) need(b, other, "contact");
      for (const Manifold& m : found) touching.push_back({p->a->id, p->b->id, m});
    }
  }
  std::sort(touching.begin(), touching.end(), [](const Touching& x, const Touching& y) {
    return std::tie(x.a, x.b, x.manifold.part_a, x.manifold.part_b) <
           std::tie(y.a, y.b, y.manifold.part_a, y.manifold.part_b);
  });
  out.Put(static_cast<uint32_t>(touching.size()));
  for (const Touching& t : touching) {
    out.Put(t.a);
    out.Put(t.b);
    out.Put(t.manifold.part_a);
    out.Put(t.manifold.part_b);
    const btPersistentManifold& m = *t.manifold.points;
    out.Put(static_cast<uint8_t>(m.getNumContacts()));
    for (int i = 0; i < m.getNumContacts(); ++i) PutPoint(m.getContactPoint(i), &out);
  }
}

absl::Status RestoreState(std::string_view bytes, BulletWorld* world) {
  State state;
  if (!Parse(bytes, &world->surroundings()->shapes, &state)) {
    return absl::InvalidArgumentError("state: damaged, or of another version");
  }
  if (absl::Status s = Check(state, *world); !s.ok()) return s;
  if (world->bodies().empty() && state.tick != world->tick()) world->SetTick(state.tick);

  for (const BodyState& b : state.bodies) world->Add(b);
  for (const JointSpec& j : state.joints) world->AddJoint(j);
  for (const ManifoldState& m : state.manifolds) {
    Body *a = world->FindAny(m.a), *b = world->FindAny(m.b);
    Pair* pair = FindPair(*a, *b);
    if (pair == nullptr || !BoxesOverlap(*a, *b)) {
      for (const BodyState& added : state.bodies) world->Remove(world->Find(added.id));
      return absl::InvalidArgumentError(
          absl::StrCat("state: contact of bodies ", m.a, " and ", m.b, ", which are apart"));
    }
    btPersistentManifold* manifold = world->contacts().Create(*pair, m.part_a, m.part_b);
    manifold->setNumContacts(static_cast<int>(m.points.size()));
    for (size_t i = 0; i < m.points.size(); ++i) manifold->getContactPoint(static_cast<int>(i)) = m.points[i];
  }
  return absl::OkStatus();
}

}  // namespace aureole::physics
