// The maths library that every executable with physics carries (EXACT.md L9): see deterministic_math.cc.
#pragma once

namespace aureole {

// Grows when a bit of any result changes: builds of different versions must not share a world.
int DeterministicMathVersion();

}  // namespace aureole
