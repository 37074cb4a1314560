#include "server/physics/ccd.h"

#include <algorithm>
#include <vector>

namespace aureole::physics {
namespace {

constexpr double kSphereShare = 0.8;          // of half the smallest extent
constexpr double kAllowedPenetration = 0.04;  // m; a motion into a surface by less is left to the contacts

class ClosestAhead : public btCollisionWorld::ClosestConvexResultCallback {
 public:
  ClosestAhead(const btVector3& from, const btVector3& to) : ClosestConvexResultCallback(from, to) {}
  btScalar addSingleResult(btCollisionWorld::LocalConvexResult& result, bool in_world) override {
    // A sphere that touches what it moves away from, or along, must not stop.
    if (result.m_hitNormalLocal.dot(m_convexToWorld - m_convexFromWorld) >= -kAllowedPenetration) return 1;
    return ClosestConvexResultCallback::addSingleResult(result, in_world);
  }
};

}  // namespace

bool Sweep(const Body& body, const btTransform& target, SweepHit* hit) {
  std::vector<Body*> candidates;
  for (const Pair* p : body.pairs) {
    Body* other = p->Other(&body);
    if (BoxesOverlap(body, *other) && MayCollide(body, *other)) candidates.push_back(other);
  }
  std::sort(candidates.begin(), candidates.end(), [](const Body* x, const Body* y) { return x->id < y->id; });

  const btSphereShape sphere(body.shape->smallest * kSphereShare);
  const btTransform& from = body.rigid.getWorldTransform();
  const btTransform to(from.getBasis(), target.getOrigin());
  ClosestAhead closest(from.getOrigin(), to.getOrigin());
  for (Body* other : candidates) {
    const double before = closest.m_closestHitFraction;
    btCollisionWorld::objectQuerySingle(&sphere, from, to, &other->rigid, other->shape->whole,
                                        other->rigid.getWorldTransform(), closest, kAllowedPenetration);
    if (closest.m_closestHitFraction < before) hit->other = other;
  }
  if (hit->other == nullptr) return false;
  hit->fraction = closest.m_closestHitFraction;
  hit->normal = closest.m_hitNormalWorld;
  return true;
}

bool MayCollide(const Body& a, const Body& b) {
  if (a.joints.empty() || b.joints.empty()) return true;
  for (const Joint* j : a.joints) {
    if (j->Other(&a) == &b && !j->spec.collide) return false;
  }
  return true;
}

}  // namespace aureole::physics
