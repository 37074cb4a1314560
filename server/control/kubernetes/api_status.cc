#include "server/control/kubernetes/api_status.h"

#include <absl/strings/cord.h>
#include <absl/strings/numbers.h>
#include <absl/strings/str_cat.h>

namespace aureole::kubernetes {
namespace {

constexpr char kReason[] = "aureole/kubernetes-reason";
constexpr char kRetryAfter[] = "aureole/kubernetes-retry-after-seconds";

absl::StatusCode CodeOf(long code, const std::string& reason) {
  switch (code) {
    case 400:
    case 413:
    case 415:
    case 422:
      return absl::StatusCode::kInvalidArgument;
    case 401:
      return absl::StatusCode::kUnauthenticated;
    case 403:
      return absl::StatusCode::kPermissionDenied;
    case 404:
      return absl::StatusCode::kNotFound;
    case 405:
      return absl::StatusCode::kUnimplemented;
    case 409:
      return reason == "AlreadyExists" ? absl::StatusCode::kAlreadyExists : absl::StatusCode::kAborted;
    case 410:
      return absl::StatusCode::kOutOfRange;
    case 408:
    case 429:
      return absl::StatusCode::kUnavailable;
    default:
      return code / 100 == 5 ? absl::StatusCode::kUnavailable : absl::StatusCode::kUnknown;
  }
}

}  // namespace

absl::Status StatusOfReply(const std::string& what, long code, const Json& body,
                           std::optional<std::chrono::seconds> retry_after) {
  const std::string reason = TextAt(body, {"reason"}), message = TextAt(body, {"message"});
  absl::Status status(CodeOf(code, reason), absl::StrCat(what, ": ", code, reason.empty() ? "" : " ", reason,
                                                         message.empty() ? "" : ": ", message));
  if (!reason.empty()) status.SetPayload(kReason, absl::Cord(reason));
  if (!retry_after) {
    if (const auto seconds = IntegerAt(body, {"details", "retryAfterSeconds"}); seconds && *seconds > 0) {
      retry_after = std::chrono::seconds(*seconds);
    }
  }
  if (retry_after) status.SetPayload(kRetryAfter, absl::Cord(absl::StrCat(retry_after->count())));
  return status;
}

std::string ReasonOf(const absl::Status& status) {
  const auto reason = status.GetPayload(kReason);
  return reason ? std::string(*reason) : std::string();
}

std::optional<std::chrono::seconds> RetryAfterOf(const absl::Status& status) {
  const auto text = status.GetPayload(kRetryAfter);
  int seconds = 0;
  if (!text || !absl::SimpleAtoi(std::string(*text), &seconds)) return std::nullopt;
  return std::chrono::seconds(seconds);
}

}  // namespace aureole::kubernetes
