// The token of our requests. A pod's is replaced in its file about every hour, and the old one stops to be valid.
#pragma once

#include <chrono>
#include <mutex>
#include <string>

#include <absl/status/statusor.h>

namespace aureole::kubernetes {

// Thread-safe.
class BearerToken {
 public:
  using Clock = std::chrono::steady_clock;
  static constexpr std::chrono::seconds kMaxAge{60};  // since the file was read

  // Either may be empty; a file goes before a fixed token.
  BearerToken(std::string fixed, std::string file);

  // Empty: requests go without. Reads the file when that was last done kMaxAge ago; while it cannot be read, the last
  // token read is used. NotFound: it could never be read.
  absl::StatusOr<std::string> Get(Clock::time_point now = Clock::now());

  // The server has refused `used`: reads the file again. True when there is another token to try.
  bool RenewAfterRefusal(const std::string& used, Clock::time_point now = Clock::now());

 private:
  absl::Status Read(Clock::time_point now);

  const std::string file_;
  std::mutex mutex_;
  std::string token_;
  Clock::time_point read_at_;
  bool have_read_ = false;
};

}  // namespace aureole::kubernetes
