#include "server/transport/security.h"

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <map>
#include <sstream>
#include <utility>

#include <absl/strings/match.h>
#include <absl/strings/numbers.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_split.h>
#include <grpcpp/security/tls_certificate_provider.h>
#include <grpcpp/security/tls_certificate_verifier.h>
#include <grpcpp/security/tls_credentials_options.h>

#include "server/transport/server_certificate.h"

namespace aureole {
namespace {

namespace tls = grpc::experimental;

constexpr unsigned kRefreshSeconds = 1;

// What the other end of a channel must be. The chain is verified before.
class ServerNameVerifier final : public tls::ExternalCertificateVerifier {
 public:
  bool Verify(tls::TlsCustomVerificationCheckRequest* request, std::function<void(grpc::Status)>,
              grpc::Status* status) override {
    const std::vector<grpc::string_ref> names = request->dns_names();
    const bool server = std::any_of(names.begin(), names.end(), [](const auto& name) { return name == kServerName; });
    *status = server ? grpc::Status::OK
                     : grpc::Status(grpc::StatusCode::UNAUTHENTICATED,
                                    absl::StrCat("its certificate does not have the DNS name ", kServerName));
    return true;
  }
  void Cancel(tls::TlsCustomVerificationCheckRequest*) override {}
};

// That they are there, and PEM. What others will find wrong with the certificate may be put right while the server
// runs.
absl::Status CheckFiles(const std::filesystem::path& directory, const std::function<void(const std::string&)>& log) {
  std::map<std::string, std::string> texts;
  for (const char* name : {"ca.crt", "tls.crt", "tls.key"}) {
    std::ifstream file(directory / name, std::ios::binary);
    std::ostringstream text;
    if (!file || !(text << file.rdbuf())) {
      return absl::NotFoundError(absl::StrCat("--tls: ", (directory / name).string(),
                                              " cannot be read; aureole certificates makes all three files"));
    }
    if (!absl::StrContains(text.str(), "-----BEGIN ")) {
      return absl::InvalidArgumentError(absl::StrCat("--tls: ", (directory / name).string(), " is not PEM"));
    }
    texts[name] = text.str();
  }
  const absl::Status own = CheckServerCertificate(texts["tls.crt"], texts["ca.crt"]);
  if (!own.ok()) {
    log(absl::StrCat("--tls: ", (directory / "tls.crt").string(), ": other servers will refuse it: ", own.message()));
  }
  return absl::OkStatus();
}

}  // namespace

std::vector<std::string> FlagsOf(const SecurityOptions& options) {
  std::vector<std::string> out;
  if (!options.tls.empty()) out.insert(out.end(), {"--tls", options.tls});
  if (!options.tokens.empty()) out.insert(out.end(), {"--tokens", options.tokens});
  if (options.insecure) out.emplace_back("--insecure");
  return out;
}

bool IsLoopback(const std::string& address) {
  if (absl::StartsWith(address, "unix:")) return true;
  const std::string host = address.substr(0, address.rfind(':'));
  if (host == "localhost" || host == "[::1]") return true;
  const std::vector<std::string> parts = absl::StrSplit(host, '.');
  return parts.size() == 4 && parts[0] == "127" && std::all_of(parts.begin(), parts.end(), [](const std::string& p) {
           int n = 0;
           return absl::SimpleAtoi(p, &n) && n >= 0 && n <= 255;
         });
}

absl::StatusOr<std::unique_ptr<Security>> Security::Open(const SecurityOptions& options) {
  std::unique_ptr<Security> out(new Security(options));
  std::unique_ptr<TokenFile> tokens;
  if (!options.tokens.empty()) {
    absl::StatusOr<std::unique_ptr<TokenFile>> opened = TokenFile::Open(options.tokens, options.log);
    if (!opened.ok())
      return absl::Status(opened.status().code(), absl::StrCat("--tokens: ", opened.status().message()));
    tokens = *std::move(opened);
  }
  const std::filesystem::path directory = options.tls;
  out->guard_ = std::make_unique<Guard>(options.tls.empty() ? "" : (directory / "ca.crt").string(), std::move(tokens));
  if (options.tls.empty()) {
    out->server_ = grpc::InsecureServerCredentials();
    out->channel_ = grpc::InsecureChannelCredentials();
    return out;
  }
  if (absl::Status s = CheckFiles(directory, options.log); !s.ok()) return s;
  const auto files = std::make_shared<tls::FileWatcherCertificateProvider>(directory / "tls.key", directory / "tls.crt",
                                                                           directory / "ca.crt", kRefreshSeconds);
  tls::TlsServerCredentialsOptions server(files);
  server.watch_identity_key_cert_pairs();
  server.watch_root_certs();
  // Clients have none, so a certificate opens nothing here; what a server shows is checked by the guard, which can say
  // what is wrong with it. A handshake that fails only closes the connection.
  server.set_cert_request_type(GRPC_SSL_REQUEST_CLIENT_CERTIFICATE_BUT_DONT_VERIFY);
  out->server_ = tls::TlsServerCredentials(server);
  tls::TlsChannelCredentialsOptions channel;
  channel.set_certificate_provider(files);
  channel.watch_identity_key_cert_pairs();
  channel.watch_root_certs();
  channel.set_certificate_verifier(tls::ExternalCertificateVerifier::Create<ServerNameVerifier>());
  channel.set_check_call_host(false);  // servers are known by kServerName, wherever they run
  out->channel_ = tls::TlsCredentials(channel);
  return out;
}

absl::Status Security::CheckListen(const std::string& address, bool clients) const {
  if (IsLoopback(address)) return absl::OkStatus();
  if (options_.tls.empty() && !options_.tokens.empty()) {
    return absl::FailedPreconditionError(absl::StrCat("--tokens: would be sent in plain text to ", address,
                                                      "; give the servers certificates with --tls"));
  }
  if (options_.insecure) return absl::OkStatus();
  if (options_.tls.empty()) {
    return absl::FailedPreconditionError(
        absl::StrCat("--listen: ", address,
                     " is not of this machine only, and plain text; give --tls, or --insecure on a "
                     "trusted network"));
  }
  if (clients && options_.tokens.empty()) {
    return absl::FailedPreconditionError(
        absl::StrCat("--listen: ", address,
                     " is not of this machine only, and clients need no token; give --tokens, or "
                     "--insecure on a trusted network"));
  }
  return absl::OkStatus();
}

absl::Status Security::CheckDial(const std::string& address) const {
  if (!options_.tls.empty() || options_.insecure || IsLoopback(address)) return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrCat(address,
                   " is not of this machine, and would be called in plain text; give --tls, or --insecure on a "
                   "trusted network"));
}

void Security::Listen(grpc::ServerBuilder* builder, const std::string& address, int* port) const {
  builder->AddListeningPort(address, server_, port);
}

}  // namespace aureole
