#include "server/control/issue_token.h"

#include <openssl/rand.h>

#include <algorithm>
#include <filesystem>

#include <absl/strings/ascii.h>
#include <absl/strings/escaping.h>
#include <absl/strings/str_cat.h>
#include <absl/time/clock.h>
#include <google/protobuf/util/json_util.h>

#include "server/control/write_file.h"
#include "server/transport/token_file.h"

namespace aureole {

absl::StatusOr<std::string> IssueToken(const std::string& path, const TokenRequest& request) {
  v1::TokenFile tokens;
  if (std::filesystem::exists(path)) {
    absl::StatusOr<v1::TokenFile> before = ReadTokens(path);
    if (!before.ok()) return before.status();
    tokens = *std::move(before);
  }
  v1::Token* const entry = tokens.add_tokens();
  entry->set_name(request.name);
  entry->set_world(request.world);
  for (const std::string& name : request.rights) {
    v1::Token::Right right = v1::Token::UNKNOWN;
    if (!v1::Token::Right_Parse(absl::AsciiStrToUpper(name), &right) || right == v1::Token::UNKNOWN) {
      return absl::InvalidArgumentError(
          absl::StrCat("--rights: '", name, "' is no right; there are watch, push, spawn and operate"));
    }
    if (std::count(entry->rights().begin(), entry->rights().end(), right) == 0) entry->add_rights(right);
  }
  if (request.life.has_value()) entry->mutable_expires()->set_seconds(absl::ToUnixSeconds(absl::Now() + *request.life));
  unsigned char random[32];
  if (RAND_bytes(random, sizeof random) != 1) return absl::InternalError("there is no randomness");
  std::string token = absl::WebSafeBase64Escape({reinterpret_cast<const char*>(random), sizeof random});
  entry->set_sha256(Sha256Hex(token));
  if (absl::Status s = CheckTokens(tokens); !s.ok()) return s;
  google::protobuf::util::JsonPrintOptions readable;
  readable.add_whitespace = true;
  std::string json;
  const auto printed = google::protobuf::util::MessageToJsonString(tokens, &json, readable);
  if (!printed.ok()) return absl::InvalidArgumentError(absl::StrCat(path, ": ", printed.message().as_string()));
  if (absl::Status s = WriteFile(path, json, 0600); !s.ok()) return s;
  return token;
}

}  // namespace aureole
