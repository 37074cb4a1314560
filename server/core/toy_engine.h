// A fast exact engine for the cluster simulation: boxes that do not turn, exchange velocities where they touch, fall
// asleep, and remember every touching pair, so that a lost contact cache shows in the bits. It honours the determinism
// contract of engine.h. No terrain but planes with an upward normal; scripts and friction coefficients are ignored.
#pragma once

#include <memory>

#include "server/core/engine.h"

namespace aureole {

std::unique_ptr<Engine> MakeToyEngine(const Environment& environment);

}  // namespace aureole
