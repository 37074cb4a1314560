// What clients send (proto/aureole/v1/simulation.proto) as the core's inputs.
#pragma once

#include <cstdint>

#include "aureole/v1/simulation.pb.h"
#include "server/core/scene.h"
#include "server/transport/spec_check.h"

namespace aureole {

// What the world allows to clients.
struct ClientLimits {
  double impulse = 1e9;           // N s, N m s
  double velocity_change = 1000;  // m/s, rad/s
  double rate = 10'000;           // inputs/s of one client
};
ClientLimits ReadClientLimits(const v1::ClientLimits& spec, SpecCheck* check);

// Without its source. A mistake is told to `check`, with fields below `path`.
Input ReadImpulse(const Path& path, const v1::Impulse& from, int64_t tick_us, SpecCheck* check);

// Whether it keeps to the limits of magnitude.
bool IsWithin(const ClientLimits& limits, const Input& input);

}  // namespace aureole
