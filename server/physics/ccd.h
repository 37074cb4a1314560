// Continuous collision detection for fast bodies: a sphere inside the body is swept along its motion.
#pragma once

#include "server/physics/body.h"

namespace aureole::physics {

// Whether a motion by `distance2` (m, squared) within a tick is swept: further than half the body's smallest extent.
inline bool MovesFast(const Body& body, double distance2) {
  return body.ccd && distance2 > body.shape->smallest * body.shape->smallest;
}

struct SweepHit {
  Body* other = nullptr;
  double fraction = 1;  // of the motion
  btVector3 normal;     // out of the other body
};

// The first body in the way from the present pose to `target`. Candidates are the bodies whose exact boxes overlap this
// one's; so who is asked is a function of the contact component (L7b). Ties go to the smaller id. Sees every body where
// it is now.
bool Sweep(const Body& body, const btTransform& target, SweepHit* hit);

// Whether joints let the two bodies collide.
bool MayCollide(const Body& a, const Body& b);

}  // namespace aureole::physics
