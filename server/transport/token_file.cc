#include "server/transport/token_file.h"

#include <openssl/crypto.h>
#include <openssl/sha.h>

#include <algorithm>
#include <fstream>
#include <set>
#include <sstream>
#include <utility>

#include <absl/strings/ascii.h>
#include <absl/strings/escaping.h>
#include <absl/strings/str_cat.h>
#include <google/protobuf/util/json_util.h>

#include "server/transport/spec_check.h"

namespace aureole {
namespace {

constexpr std::chrono::seconds kLookEvery(1);

bool IsHash(const std::string& text) {
  return text.size() == 2 * SHA256_DIGEST_LENGTH &&
         std::all_of(text.begin(), text.end(), [](char c) { return absl::ascii_isdigit(c) || (c >= 'a' && c <= 'f'); });
}

bool SameFile(const struct stat& a, const struct stat& b) {
  return a.st_dev == b.st_dev && a.st_ino == b.st_ino && a.st_size == b.st_size &&
         a.st_mtim.tv_sec == b.st_mtim.tv_sec && a.st_mtim.tv_nsec == b.st_mtim.tv_nsec;
}

}  // namespace

absl::Status CheckTokens(const v1::TokenFile& file) {
  SpecCheck check;
  std::set<std::string> hashes;
  for (int i = 0; i < file.tokens_size(); ++i) {
    const Path path = (Path() / "tokens")[i];
    const v1::Token& token = file.tokens(i);
    if (token.name().empty()) check.Fail(path / "name", "must be set: whose token it is", v1::MISSING);
    if (token.world().empty()) check.Fail(path / "world", "must be set: the world's name", v1::MISSING);
    if (!IsHash(token.sha256())) {
      check.Fail(path / "sha256", "must be 64 lower-case hexadecimal digits; aureole token makes entries");
    } else if (!hashes.insert(token.sha256()).second) {
      check.Fail(path / "sha256", "is that of an earlier entry; give each one token", v1::CONFLICT);
    }
    if (token.rights().empty())
      check.Fail(path / "rights", "must have one of WATCH, PUSH, SPAWN, OPERATE", v1::MISSING);
    for (int r = 0; r < token.rights_size(); ++r) {
      if (token.rights(r) < v1::Token::WATCH || token.rights(r) > v1::Token::OPERATE) {
        check.Fail((path / "rights")[r], "must be one of WATCH, PUSH, SPAWN, OPERATE");
      }
    }
  }
  return check.status();
}

std::string Sha256Hex(const std::string& text) {
  unsigned char digest[SHA256_DIGEST_LENGTH];
  SHA256(reinterpret_cast<const unsigned char*>(text.data()), text.size(), digest);
  return absl::BytesToHexString({reinterpret_cast<const char*>(digest), sizeof digest});
}

absl::StatusOr<v1::TokenFile> ReadTokens(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::ostringstream text;
  // Nothing is written to `text` from an empty file, which is a failure to the stream.
  if (!file) return absl::NotFoundError(absl::StrCat(path, ": cannot be read as a file of tokens"));
  text << file.rdbuf();
  v1::TokenFile tokens;
  const auto parsed = google::protobuf::util::JsonStringToMessage(text.str(), &tokens);
  if (!parsed.ok()) {
    return absl::InvalidArgumentError(absl::StrCat(path, ": ", parsed.message().as_string(),
                                                   "; token.proto has the fields, aureole token makes entries"));
  }
  const absl::Status sane = CheckTokens(tokens);
  if (!sane.ok()) return absl::InvalidArgumentError(absl::StrCat(path, ": ", sane.message()));
  return tokens;
}

TokenFile::TokenFile(std::string path, std::function<void(const std::string&)> log)
    : path_(std::move(path)), log_(std::move(log)) {}

absl::StatusOr<std::unique_ptr<TokenFile>> TokenFile::Open(const std::string& path,
                                                           std::function<void(const std::string&)> log) {
  std::unique_ptr<TokenFile> out(new TokenFile(path, std::move(log)));
  // Before it is read: a file that is changed meanwhile is read again.
  stat(path.c_str(), &out->read_);
  absl::StatusOr<v1::TokenFile> tokens = ReadTokens(path);
  if (!tokens.ok()) return tokens.status();
  out->tokens_ = *std::move(tokens);
  out->looked_ = std::chrono::steady_clock::now();
  return out;
}

std::optional<v1::Token> TokenFile::Find(const std::string& token) {
  const std::string hash = Sha256Hex(token);
  const std::lock_guard lock(mutex_);
  Refresh();
  const v1::Token* found = nullptr;
  for (const v1::Token& t : tokens_.tokens()) {
    if (CRYPTO_memcmp(t.sha256().data(), hash.data(), hash.size()) == 0) found = &t;
  }
  return found == nullptr ? std::nullopt : std::optional<v1::Token>(*found);
}

void TokenFile::Refresh() {
  const auto now = std::chrono::steady_clock::now();
  if (now - looked_ < kLookEvery) return;
  looked_ = now;
  struct stat file = {};
  stat(path_.c_str(), &file);
  if (SameFile(file, read_)) return;
  read_ = file;
  absl::StatusOr<v1::TokenFile> tokens = ReadTokens(path_);
  if (tokens.ok()) {
    tokens_ = *std::move(tokens);
    log_(absl::StrCat(path_, ": read again, ", tokens_.tokens_size(), " tokens"));
  } else {
    log_(absl::StrCat(tokens.status().message(), "; the tokens of before stay"));
  }
}

}  // namespace aureole
