// Narrow phase: Bullet's contact algorithms for pairs of bodies, in an order and with a lifetime that are functions of
// the two bodies only (EXACT.md L1, L2, L8).
#pragma once

#include <vector>

#include "server/physics/body.h"

namespace aureole::physics {

// One manifold of a pair, and where it stands among the pair's manifolds.
struct Manifold {
  uint32_t part_a = 0, part_b = 0;
  btPersistentManifold* points = nullptr;
};

class Contacts {
 public:
  // `pool`: manifolds to keep room for; more are allocated one by one.
  Contacts(int pool, double dt);

  // Refreshes the contact points of a pair whose boxes overlap and appends its manifolds that have points.
  void Find(Pair& pair, std::vector<Manifold>* out);
  // Frees what the pair holds.
  void Release(Pair& pair);
  // Appends the manifolds that have points, as they are.
  void List(const Pair& pair, std::vector<Manifold>* out) const;
  // The manifold of these parts, made if need be and then empty; for restoring its points.
  btPersistentManifold* Create(Pair& pair, uint32_t part_a, uint32_t part_b);

  btCollisionDispatcher* dispatcher() { return &dispatcher_; }
  int64_t CountPoints() const;

 private:
  // A part where it is now.
  struct Placed {
    btTransform at;
    btVector3 low, high;
  };
  void Place(const Body& body, std::vector<Placed>* out) const;
  void Touch(Pair& pair, PartContact* contact, const btTransform& at_a, const btTransform& at_b);
  void FindParts(Pair& pair);
  void Free(PartContact* contact);

  btDefaultCollisionConfiguration configuration_;
  btCollisionDispatcher dispatcher_;
  btDispatcherInfo info_;
  std::vector<Placed> placed_a_, placed_b_;
  mutable btManifoldArray found_;
};

}  // namespace aureole::physics
