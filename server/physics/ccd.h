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
  double fraction = 1;  // of the tick's motion
  btVector3 way;        // m; the body's motion until then, relative to the other one
  btVector3 normal;     // out of the other body
};

// The first body that this one meets within `dt` seconds when it moves by `motion` (m) and the others go on at their
// velocities. Candidates are the bodies whose exact boxes overlap this one's; so who is asked is a function of the
// contact component (L7b). Ties go to the smaller id. Sees every body where it is now.
bool Sweep(const Body& body, const btVector3& motion, double dt, SweepHit* hit);

// Whether joints let the two bodies collide.
bool MayCollide(const Body& a, const Body& b);

}  // namespace aureole::physics
