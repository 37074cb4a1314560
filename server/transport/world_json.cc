#include "server/transport/world_json.h"

#include <algorithm>
#include <fstream>
#include <sstream>
#include <vector>

#include <absl/status/status.h>
#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_replace.h>
#include <absl/strings/str_split.h>
#include <absl/strings/strip.h>
#include <google/protobuf/util/json_util.h>

#include "server/core/limits.h"

namespace aureole {
namespace {

// What protobuf calls a type -> what a user calls it.
std::string TypeInWords(const std::string& type) {
  if (type == "TYPE_DOUBLE") return "a number";
  if (type == "TYPE_STRING") return "a text in quotes";
  if (type == "TYPE_BOOL") return "true or false";
  if (type == "TYPE_UINT32" || type == "TYPE_UINT64") return "a whole number, 0 or more";
  if (absl::EndsWith(type, "Duration")) return "a duration in seconds, such as \"0.016s\"";
  if (absl::EndsWith(type, "ExchangeSpec.Policy")) return "one of \"TOLERANCE\", \"REACH\"";
  return "an object {...} with the fields of world.proto's " + type.substr(type.rfind('.') + 1);
}

constexpr size_t kMaxQuote = 80;  // characters of the user's text that a message repeats

// A map's entry is called [n].value by protobuf.
std::string FieldPath(absl::string_view path, absl::string_view name = "") {
  return absl::StrReplaceAll(absl::StrCat(path, path.empty() || name.empty() ? "" : ".", name), {{"].value", "]"}});
}

// Protobuf's message -> "<path>: <what>". It has the forms
//   (path) name: Cannot find field.                            without "(path) " at the root; other texts as well
//   (path): invalid value oneof field 'x' is already set. Cannot set 'y' for type oneof
//   (path): invalid value V for type T
// and, where the text is not JSON, a sentence, an excerpt of the text, and a caret below it.
std::string Explain(absl::string_view message) {
  const absl::string_view whole = message;
  absl::string_view path;
  if (absl::ConsumePrefix(&message, "(")) {
    path = message.substr(0, message.find(')'));
    message.remove_prefix(std::min(message.size(), path.size() + 1));
  }
  if (absl::ConsumePrefix(&message, ": invalid value ")) {
    constexpr absl::string_view kCannotSet = "Cannot set '", kForType = " for type ";
    if (const size_t at = message.find(kCannotSet); at != message.npos && absl::StartsWith(message, "oneof field")) {
      const absl::string_view name = message.substr(at + kCannotSet.size());
      return absl::StrCat(FieldPath(path, name.substr(0, name.find('\''))),
                          ": is given beside another field of the same choice; give only one");
    }
    const size_t at = std::min(message.rfind(kForType), message.size());
    const absl::string_view type = absl::StripPrefix(message.substr(at), kForType);
    return absl::StrCat(FieldPath(path), ": must be ", TypeInWords(std::string(type)), " (is ",
                        message.substr(0, std::min(at, kMaxQuote)), ")");
  }
  message = absl::StripLeadingAsciiWhitespace(message);
  if (absl::ConsumeSuffix(&message, ": Cannot find field.")) {
    return absl::StrCat(FieldPath(path, message.substr(0, kMaxQuote)),
                        ": there is no such field; world.proto lists them");
  }
  if (!path.empty()) {
    const absl::string_view name = message.substr(0, message.find(':'));
    return absl::StrCat(FieldPath(path, name), message.substr(name.size(), kMaxQuote));
  }
  const std::vector<absl::string_view> lines = absl::StrSplit(whole, '\n');
  return absl::StrCat("JSON: ", absl::StripPrefix(lines[0], ": "),
                      lines.size() > 1 ? absl::StrCat(" Near: ", lines[1]) : "");
}

}  // namespace

absl::StatusOr<v1::WorldSpec> SpecFromJson(std::string_view json) {
  if (json.size() > limits::kMaxWorldFileBytes) {
    return absl::InvalidArgumentError(
        absl::StrCat("JSON: the text is larger than kMaxWorldFileBytes (", limits::kMaxWorldFileBytes, " bytes)"));
  }
  v1::WorldSpec spec;
  const auto status = google::protobuf::util::JsonStringToMessage({json.data(), json.size()}, &spec);
  if (!status.ok()) return absl::InvalidArgumentError(Explain(status.message().as_string()));
  return spec;
}

absl::StatusOr<v1::WorldSpec> SpecFromFile(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::ostringstream text;
  if (!file || !(text << file.rdbuf())) return absl::NotFoundError(path + ": cannot be read as a world file");
  return SpecFromJson(text.str());
}

absl::StatusOr<std::string> SpecToJson(const v1::WorldSpec& spec) {
  google::protobuf::util::JsonPrintOptions options;
  options.add_whitespace = true;
  options.preserve_proto_field_names = true;
  std::string json;
  const auto status = google::protobuf::util::MessageToJsonString(spec, &json, options);
  if (!status.ok()) return absl::InvalidArgumentError(Explain(status.message().as_string()));
  return json;
}

}  // namespace aureole
