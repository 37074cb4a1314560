// What the API says when it refuses, as absl::Status.
//
//   400, 413, 415, 422  InvalidArgument     401  Unauthenticated     403  PermissionDenied     404  NotFound
//   405                 Unimplemented       409  AlreadyExists when that is the reason, else Aborted (a conflict: read
//   410                 OutOfRange               the object again and redo)
//   408, 429, 5xx       Unavailable         others  Unknown
#pragma once

#include <chrono>
#include <optional>
#include <string>

#include <absl/status/status.h>

#include "server/control/kubernetes/json.h"

namespace aureole::kubernetes {

// `body` is the v1 Status that came with an HTTP status, or in an ERROR event of a watch; or anything, if it is none.
// The message reads "<what>: 404 NotFound: pods "a" not found".
absl::Status StatusOfReply(const std::string& what, long code, const Json& body,
                           std::optional<std::chrono::seconds> retry_after = std::nullopt);

// The API's own word for it ("NotFound", "Conflict", "Expired"); empty when the status is not from the API.
std::string ReasonOf(const absl::Status& status);

// When the server wants to be asked again.
std::optional<std::chrono::seconds> RetryAfterOf(const absl::Status& status);

}  // namespace aureole::kubernetes
