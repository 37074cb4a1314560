// New entries of a file of tokens (proto/aureole/v1/token.proto).
#pragma once

#include <optional>
#include <string>
#include <vector>

#include <absl/status/statusor.h>
#include <absl/time/time.h>

namespace aureole {

struct TokenRequest {
  std::string name, world;
  std::vector<std::string> rights;     // watch, push, spawn, operate, in any case
  std::optional<absl::Duration> life;  // none: it does not expire
};

// Adds an entry to the file, which is made when missing (readable to its owner only), and returns the token: 256 random
// bits as text, which nothing keeps. InvalidArgument for a right that does not exist, or a file that is not sane;
// PermissionDenied when it cannot be written. The file is replaced as a whole; two at a time may lose an entry.
absl::StatusOr<std::string> IssueToken(const std::string& path, const TokenRequest& request);

}  // namespace aureole
