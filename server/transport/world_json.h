// A WorldSpec as text: JSON in protobuf's own mapping, with the field names of world.proto. Thread-safe.
#pragma once

#include <string>
#include <string_view>

#include <absl/status/statusor.h>

#include "aureole/v1/world.pb.h"

namespace aureole {

// InvalidArgument "<path>: <what>" for a field that does not exist or has the wrong type, "JSON: <what>, near: <text>"
// where it is not JSON. Says nothing of the values.
absl::StatusOr<v1::WorldSpec> SpecFromJson(std::string_view json);

// As SpecFromJson; NotFound, with the file's path, when it cannot be read.
absl::StatusOr<v1::WorldSpec> SpecFromFile(const std::string& path);

// Readable JSON that SpecFromJson turns into the same spec. InvalidArgument for what JSON cannot hold, such as a
// duration of 10^13 s.
absl::StatusOr<std::string> SpecToJson(const v1::WorldSpec& spec);

}  // namespace aureole
