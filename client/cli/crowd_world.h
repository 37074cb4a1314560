// The crowds of `aureole experiment --policies`: the arena in which PROTOCOL.md sections 8 and 10 measured its model,
// with real bodies. Pure functions; the same spec on every machine.
#pragma once

#include <cstdint>
#include <string>

#include "aureole/v1/world.pb.h"
#include "server/control/world_file.h"

namespace aureole {

struct Crowd {
  double density = 0.2;  // bodies/m^2, > 0; at most 1, or they find no place without overlap
  bool fast = false;     // 2 % of the kicks are 9.6 to 32 m/s; all others, and all when false, up to 5 m/s
  uint64_t seed = 1;
  Tick ticks = 1250;  // that have kicks
};

inline constexpr int64_t kCrowdTickUs = 16000;
inline constexpr double kCrowdWidth = 80, kCrowdDepth = 30;  // m, along x and z, around the origin

// "crowd-20-slow": bodies per 100 m^2, and the kicks.
std::string CrowdName(const Crowd& crowd);

// A flat plane between four walls, in two columns that meet at x = 0, with spheres and crates of bounding radius 0.2 to
// 0.4 m that lie apart and move at up to 5 m/s. In each tick 1 % of the bodies, drawn independently, get a new
// horizontal velocity, as in the model; between kicks they hardly lose any, for bodies at rest make an easy crowd.
// Speed tolerance and speed limit are 32 m/s and nothing spawns, so the trajectories do not depend on the exchange,
// which is left to the caller. Cost: linear in bodies x ticks.
v1::WorldSpec CrowdWorld(const Crowd& crowd);

}  // namespace aureole
