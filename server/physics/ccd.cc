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

bool Sweep(const Body& body, const btVector3& motion, double dt, SweepHit* hit) {
  std::vector<Body*> candidates;
  for (const Pair* p : body.pairs) {
    Body* other = p->Other(&body);
    if (BoxesOverlap(body, *other) && MayCollide(body, *other)) candidates.push_back(other);
  }
  std::sort(candidates.begin(), candidates.end(), [](const Body* x, const Body* y) { return x->id < y->id; });

  const btSphereShape sphere(body.shape->smallest * kSphereShare);
  const btTransform& from = body.rigid.getWorldTransform();
  for (Body* other : candidates) {
    // In the other's frame, so that two bodies shot at each other meet. A kinematic body is already where it goes.
    btVector3 relative = motion;
    if (other->dynamic()) relative -= other->rigid.getLinearVelocity() * dt;
    const btTransform to(from.getBasis(), from.getOrigin() + relative);
    ClosestAhead closest(from.getOrigin(), to.getOrigin());
    closest.m_closestHitFraction = hit->fraction;
    btCollisionWorld::objectQuerySingle(&sphere, from, to, &other->rigid, other->shape->whole,
                                        other->rigid.getWorldTransform(), closest, kAllowedPenetration);
    if (closest.m_closestHitFraction >= hit->fraction) continue;
    hit->other = other;
    hit->fraction = closest.m_closestHitFraction;
    hit->way = relative * hit->fraction;
    hit->normal = closest.m_hitNormalWorld;
  }
  return hit->other != nullptr;
}

bool MayCollide(const Body& a, const Body& b) {
  if (a.joints.empty() || b.joints.empty()) return true;
  for (const Joint* j : a.joints) {
    if (j->Other(&a) == &b && !j->spec.collide) return false;
  }
  return true;
}

}  // namespace aureole::physics
