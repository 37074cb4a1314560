// The tokens of clients (proto/aureole/v1/token.proto), as a file says them now.
#pragma once

#include <sys/stat.h>

#include <chrono>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>

#include <absl/status/statusor.h>

#include "aureole/v1/token.pb.h"

namespace aureole {

// 64 lower-case hexadecimal digits.
std::string Sha256Hex(const std::string& text);

// InvalidArgument "<field>: <what>" for entries that are not sane: unknown rights or none, a hash that is none or is
// there twice, no world or name.
absl::Status CheckTokens(const v1::TokenFile& tokens);

// InvalidArgument "<path>: <what>" for a file that is not JSON, or not sane. NotFound when it cannot be read.
absl::StatusOr<v1::TokenFile> ReadTokens(const std::string& path);

// Thread-safe.
class TokenFile {
 public:
  // As ReadTokens. `log` is told of files that are not sane later; the tokens of the last sane one stay then.
  static absl::StatusOr<std::unique_ptr<TokenFile>> Open(const std::string& path,
                                                         std::function<void(const std::string&)> log);

  // The entry of this token, expired or not. Reads the file again when it has changed, which is looked up once a second
  // at most. Cost: a hash, and a comparison with each entry, in a time that does not depend on what is equal.
  std::optional<v1::Token> Find(const std::string& token);

 private:
  TokenFile(std::string path, std::function<void(const std::string&)> log);
  // Holds the mutex.
  void Refresh();

  const std::string path_;
  const std::function<void(const std::string&)> log_;
  std::mutex mutex_;
  v1::TokenFile tokens_;
  struct stat read_ = {};  // the file that tokens_ is of, or that was not sane
  std::chrono::steady_clock::time_point looked_;
};

}  // namespace aureole
