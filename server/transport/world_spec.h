// The world file: a WorldSpec, validated, in the core's types. Every function is a pure one of its argument, with the
// same bits on every machine, so that all regions that read a spec hold the same world. Thread-safe.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include <absl/status/statusor.h>

#include "aureole/v1/world.pb.h"
#include "server/core/world.h"

namespace aureole {

// InvalidArgument "<field's path>: <what is wanted> (is <what is there>); <remedy>" for the first value that is not
// sane. Cost: linear in the spec, and O(n^4) in the points of a hull.
absl::StatusOr<World> WorldFromSpec(const v1::WorldSpec& spec);

// SpecFromJson or SpecFromFile (world_json.h), then WorldFromSpec.
absl::StatusOr<World> LoadWorld(std::string_view json);
absl::StatusOr<World> LoadWorldFile(const std::string& path);

// Of the deterministic serialisation: servers that agree on it read the same world, if they run the same binary.
uint64_t WorldHash(const v1::WorldSpec& spec);

}  // namespace aureole
