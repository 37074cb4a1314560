// How servers prove who they are: mutual TLS among them, TLS and tokens for clients, plain text where nobody else
// hears.
//
// The directory is laid out as a Kubernetes TLS secret is mounted: ca.crt, tls.crt and tls.key, PEM. A server's
// certificate has the DNS name kServerName; whoever has such a one of the same authority is a server of this
// installation to all others, and to its clients. A certificate without that name opens nothing. Files that change are
// served to new connections within two seconds; connections that exist go on.
#pragma once

#include <functional>
#include <memory>
#include <string>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>
#include <grpcpp/security/credentials.h>
#include <grpcpp/security/server_credentials.h>
#include <grpcpp/server_builder.h>

#include "server/transport/guard.h"
#include "server/transport/server_certificate.h"

namespace aureole {

struct SecurityOptions {
  std::string tls;        // the directory; empty: plain text
  std::string tokens;     // token.proto as JSON; empty: clients need none
  bool insecure = false;  // plain text, and clients without tokens, beyond this machine too
  std::function<void(const std::string&)> log = [](const std::string&) {};  // any thread
};

// The command line of a server that has these options.
std::vector<std::string> FlagsOf(const SecurityOptions& options);

// host:port of this machine only: localhost, 127.0.0.0/8, ::1, or a Unix socket.
bool IsLoopback(const std::string& address);

class Security {
 public:
  // NotFound or InvalidArgument, with the flag, when a file is missing or is none of its kind.
  static absl::StatusOr<std::unique_ptr<Security>> Open(const SecurityOptions& options);

  // FailedPrecondition, with the flags that help, when what is served here would be open to others: an address beyond
  // this machine in plain text, or without tokens for clients (`clients`: it serves some).
  absl::Status CheckListen(const std::string& address, bool clients) const;
  // FailedPrecondition when a server there would be called in plain text.
  absl::Status CheckDial(const std::string& address) const;

  // Before its services are registered with guard().
  void Listen(grpc::ServerBuilder* builder, const std::string& address, int* port) const;
  // For channels to other servers: shows our certificate, and wants a server's.
  std::shared_ptr<grpc::ChannelCredentials> channel() const { return channel_; }
  Guard& guard() { return *guard_; }

 private:
  explicit Security(SecurityOptions options) : options_(std::move(options)) {}

  const SecurityOptions options_;
  std::shared_ptr<grpc::ServerCredentials> server_;
  std::shared_ptr<grpc::ChannelCredentials> channel_;
  std::unique_ptr<Guard> guard_;
};

}  // namespace aureole
