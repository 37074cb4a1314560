// What an input does to the bodies of one engine.
#pragma once

#include <cstdint>

#include "server/core/engine.h"

namespace aureole {

// Applies the input to every body here that it means, in ascending order of ids, and returns how many that were. Where
// several engines hold a world, applying it to each has the effect of applying it to the whole (P77).
int64_t ApplyInput(const Input& input, Engine* engine);

}  // namespace aureole
