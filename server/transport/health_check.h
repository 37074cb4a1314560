// Asks a server's standard health service (grpc.health.v1), for probes that have no client of their own.
#pragma once

#include <memory>
#include <string>

#include <absl/status/status.h>
#include <grpcpp/security/credentials.h>

namespace aureole {

// OK when `address` (host:port) says SERVING within two seconds; else Unavailable with what it said.
absl::Status CheckHealth(const std::string& address, const std::shared_ptr<grpc::ChannelCredentials>& credentials =
                                                         grpc::InsecureChannelCredentials());

}  // namespace aureole
