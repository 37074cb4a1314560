// Bullet constraints for joints.
#pragma once

#include <memory>

#include "server/core/scene.h"
#include "server/physics/bullet.h"

namespace aureole::physics {

// The constraint between two bodies; for a joint to the world, `b` is a static body at the origin. A pure function of
// the description: Bullet's constraints keep no state from one tick to the next (they do not warm start), so a joint
// that is made anew goes on with the same bits.
//
// A hinge's angle is that of a relative to b about the axis; it is zero where the shortest arc from axis_a to axis_b
// turns a's frame into b's.
std::unique_ptr<btTypedConstraint> MakeConstraint(const JointSpec& spec, btRigidBody& a, btRigidBody& b);

}  // namespace aureole::physics
