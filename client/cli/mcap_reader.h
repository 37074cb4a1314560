// Reads MCAP files (mcap.dev/spec) from the front to the end, such as McapWriter writes. Compressed chunks are refused.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <string_view>

#include <absl/status/status.h>

namespace aureole {

struct McapMessage {
  std::string_view topic, type;  // `type`: the full name of the protobuf message
  uint64_t time_ns = 0;
  std::string_view data;
};

// Calls `take` for every message, in the order of the file; a status that is not OK ends it and is returned. NotFound:
// no such file; InvalidArgument names what is wrong and where. `*whole` says whether the file has its end; one that has
// not was cut off, and all before was taken.
absl::Status ReadMcap(const std::string& path, const std::function<absl::Status(const McapMessage&)>& take,
                      bool* whole);

}  // namespace aureole
