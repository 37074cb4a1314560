// The physics engine on Bullet 3.24, float64: every shape and joint of core/scene.h, bit-exact under migration.
//
// Sleep: an island sleeps when all its members have been slower than sleep_linear (strictly) and sleep_angular for
// sleep_after; sleep_linear = 0 turns sleeping off. Speed limit: after every solve and every change from outside.
// Exact box: the shape's box grown by 2 cm; for a body with CCD that is about to move further than half its smallest
// extent, united with the box at the end of that motion.
// Removing a body wakes the bodies it has contact points with, and its joint partners.
// Needs the maths library of deterministic_math.h in the executable.
#pragma once

#include <memory>

#include "server/core/engine.h"

namespace aureole {

std::unique_ptr<Engine> MakeBulletEngine(const Environment& environment);

}  // namespace aureole
