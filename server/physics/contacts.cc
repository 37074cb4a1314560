#include "server/physics/contacts.h"

#include <algorithm>
#include <tuple>

#include "server/core/check.h"

namespace aureole::physics {
namespace {

btDefaultCollisionConstructionInfo Pools(int size) {
  btDefaultCollisionConstructionInfo info;
  info.m_defaultMaxPersistentManifoldPoolSize = size;
  info.m_defaultMaxCollisionAlgorithmPoolSize = size;
  return info;
}

}  // namespace

Contacts::Contacts(int pool, double dt) : configuration_(Pools(pool)), dispatcher_(&configuration_) {
  info_.m_timeStep = dt;
}

void Contacts::Find(Pair& pair, std::vector<Manifold>* out) {
  if (pair.a->shape->compound() || pair.b->shape->compound()) {
    FindParts(pair);
  } else {
    if (pair.contacts.empty()) pair.contacts.emplace_back();
    Touch(pair, &pair.contacts.front(), pair.a->rigid.getWorldTransform(), pair.b->rigid.getWorldTransform());
  }
  const size_t before = out->size();
  pair.touches = true;
  List(pair, out);
  pair.touches = out->size() > before;
}

void Contacts::List(const Pair& pair, std::vector<Manifold>* out) const {
  if (!pair.touches) return;
  for (const PartContact& c : pair.contacts) {
    found_.resize(0);
    c.algorithm->getAllContactManifolds(found_);
    for (int i = 0; i < found_.size(); ++i) {
      if (found_[i]->getNumContacts() > 0) out->push_back({c.part_a, c.part_b, found_[i]});
    }
  }
}

void Contacts::Place(const Body& body, std::vector<Placed>* out) const {
  out->clear();
  const btVector3 margin(kBreakingMargin, kBreakingMargin, kBreakingMargin);
  for (const CollisionShape::Part& part : body.shape->parts) {
    Placed& p = out->emplace_back();
    p.at = body.shape->compound() ? body.rigid.getWorldTransform() * part.local : body.rigid.getWorldTransform();
    part.shape->getAabb(p.at, p.low, p.high);
    p.low -= margin;
    p.high += margin;
  }
}

// Parts touch iff their own boxes overlap now: Bullet's compound algorithms keep some children longer than they would
// create them (L8), so we pair the parts ourselves.
void Contacts::FindParts(Pair& pair) {
  Place(*pair.a, &placed_a_);
  Place(*pair.b, &placed_b_);
  size_t at = 0;
  for (uint32_t i = 0; i < placed_a_.size(); ++i) {
    for (uint32_t j = 0; j < placed_b_.size(); ++j) {
      const Placed &a = placed_a_[i], &b = placed_b_[j];
      const bool known = at < pair.contacts.size() && pair.contacts[at].part_a == i && pair.contacts[at].part_b == j;
      const bool overlap = a.low.x() <= b.high.x() && b.low.x() <= a.high.x() && a.low.y() <= b.high.y() &&
                           b.low.y() <= a.high.y() && a.low.z() <= b.high.z() && b.low.z() <= a.high.z();
      if (!overlap) {
        if (known) {
          Free(&pair.contacts[at]);
          pair.contacts.erase(pair.contacts.begin() + static_cast<std::ptrdiff_t>(at));
        }
        continue;
      }
      if (!known) pair.contacts.insert(pair.contacts.begin() + static_cast<std::ptrdiff_t>(at), {i, j, nullptr});
      Touch(pair, &pair.contacts[at], a.at, b.at);
      ++at;
    }
  }
}

void Contacts::Touch(Pair& pair, PartContact* contact, const btTransform& at_a, const btTransform& at_b) {
  const CollisionShape &sa = *pair.a->shape, &sb = *pair.b->shape;
  const int index_a = sa.compound() ? static_cast<int>(contact->part_a) : -1;
  const int index_b = sb.compound() ? static_cast<int>(contact->part_b) : -1;
  const btCollisionObjectWrapper a(nullptr, sa.parts[contact->part_a].shape, &pair.a->rigid, at_a, -1, index_a);
  const btCollisionObjectWrapper b(nullptr, sb.parts[contact->part_b].shape, &pair.b->rigid, at_b, -1, index_b);
  if (contact->algorithm == nullptr) {
    contact->algorithm = dispatcher_.findAlgorithm(&a, &b, nullptr, BT_CONTACT_POINT_ALGORITHMS);
  }
  btManifoldResult result(&a, &b);
  result.setShapeIdentifiersA(-1, index_a);
  result.setShapeIdentifiersB(-1, index_b);
  contact->algorithm->processCollision(&a, &b, info_, &result);
}

void Contacts::Free(PartContact* contact) {
  contact->algorithm->~btCollisionAlgorithm();
  dispatcher_.freeCollisionAlgorithm(contact->algorithm);
}

void Contacts::Release(Pair& pair) {
  for (PartContact& c : pair.contacts) Free(&c);
  pair.contacts.clear();
  pair.touches = false;
}

btPersistentManifold* Contacts::Create(Pair& pair, uint32_t part_a, uint32_t part_b) {
  auto it = std::lower_bound(pair.contacts.begin(), pair.contacts.end(), std::tuple(part_a, part_b),
                             [](const PartContact& c, const std::tuple<uint32_t, uint32_t>& parts) {
                               return std::tuple(c.part_a, c.part_b) < parts;
                             });
  if (it == pair.contacts.end() || it->part_a != part_a || it->part_b != part_b) {
    it = pair.contacts.insert(it, {part_a, part_b, nullptr});
    const btTransform at_a = pair.a->rigid.getWorldTransform() * pair.a->shape->parts[part_a].local;
    const btTransform at_b = pair.b->rigid.getWorldTransform() * pair.b->shape->parts[part_b].local;
    Touch(pair, &*it, at_a, at_b);  // Bullet makes most manifolds on first use
  }
  found_.resize(0);
  it->algorithm->getAllContactManifolds(found_);
  AUREOLE_CHECK(found_.size() == 1, "bodies %llu and %llu, parts %u and %u: %d manifolds",
                static_cast<unsigned long long>(pair.a->id), static_cast<unsigned long long>(pair.b->id), part_a,
                part_b, found_.size());
  found_[0]->clearManifold();
  pair.touches = true;
  return found_[0];
}

int64_t Contacts::CountPoints() const {
  int64_t points = 0;
  for (int i = 0; i < dispatcher_.getNumManifolds(); ++i) {
    points += const_cast<btCollisionDispatcher&>(dispatcher_).getManifoldByIndexInternal(i)->getNumContacts();
  }
  return points;
}

}  // namespace aureole::physics
