#include "server/control/kubernetes/bearer_token.h"

#include <utility>

#include "server/control/kubernetes/cluster_access.h"

namespace aureole::kubernetes {

BearerToken::BearerToken(std::string fixed, std::string file) : file_(std::move(file)) {
  if (file_.empty()) token_ = std::move(fixed);
}

absl::StatusOr<std::string> BearerToken::Get(Clock::time_point now) {
  const std::lock_guard lock(mutex_);
  if (!file_.empty() && (!have_read_ || now - read_at_ >= kMaxAge)) {
    if (absl::Status s = Read(now); !s.ok() && !have_read_) return s;
  }
  return token_;
}

bool BearerToken::RenewAfterRefusal(const std::string& used, Clock::time_point now) {
  const std::lock_guard lock(mutex_);
  if (file_.empty()) return false;
  return Read(now).ok() && token_ != used;
}

absl::Status BearerToken::Read(Clock::time_point now) {
  absl::StatusOr<std::string> token = ReadToken(file_);
  if (!token.ok()) return token.status();
  token_ = *std::move(token);
  read_at_ = now;
  have_read_ = true;
  return absl::OkStatus();
}

}  // namespace aureole::kubernetes
