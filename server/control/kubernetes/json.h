// Objects of the API as JSON, read without exceptions: what is missing or of another type is empty.
#pragma once

#include <cstdint>
#include <initializer_list>
#include <optional>
#include <string>

#include <absl/status/statusor.h>
#include <nlohmann/json.hpp>

namespace aureole::kubernetes {

using Json = nlohmann::json;

// InvalidArgument, with the place, when `text` is not JSON.
absl::StatusOr<Json> ParseJson(const std::string& text);

// On one line; bytes that are not UTF-8 are replaced.
std::string ToText(const Json& json);

// The value at a path of keys, such as {"metadata", "name"}; null when there is none.
const Json* Find(const Json& json, std::initializer_list<const char*> path);
// Likewise; empty when there is none or it is not a string.
std::string TextAt(const Json& json, std::initializer_list<const char*> path);
std::optional<int64_t> IntegerAt(const Json& json, std::initializer_list<const char*> path);

}  // namespace aureole::kubernetes
