// Where a script puts a kinematic body (P40).
#pragma once

#include "server/core/scene.h"
#include "server/physics/bullet.h"

namespace aureole::physics {

// The pose at `seconds` of simulated time: linear in position, slerp in orientation between keys, constant outside.
// `rest` when the script has no keys.
btTransform PoseAt(const Script& script, double seconds, const btTransform& rest);

}  // namespace aureole::physics
