// A world file, read and checked: what a run is started with.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include <absl/status/statusor.h>

#include "aureole/v1/world.pb.h"
#include "server/core/world.h"

namespace aureole {

struct WorldFile {
  std::string path;
  v1::WorldSpec spec;
  World world;  // what the spec says
};

// The message of an error begins with the file's path, then the field's: "worlds/a.json: bodies[3].shape.radius: ...".
// NotFound: it cannot be read. InvalidArgument: it is not a world that could run.
absl::StatusOr<WorldFile> OpenWorldFile(const std::string& path, std::optional<uint64_t> seed = std::nullopt);

// Why it is not a world that could run, as OpenWorldFile would say.
absl::Status CheckWorld(const v1::WorldSpec& spec);

// What a person wants to know of a world before running it, a line each: regions, bodies, the layout's chain number m,
// the paper's aura (Eqs. 1-4) and our margins (PROTOCOL.md section 1) side by side.
std::vector<std::string> DescribeWorld(const World& world);

// Ticks until `seconds` of simulated time have passed, at least one.
Tick TicksIn(double seconds, int64_t tick_us);

}  // namespace aureole
