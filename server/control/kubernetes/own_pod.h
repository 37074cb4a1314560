// What a control plane takes from its own Pod and Service, and what it writes there.
#pragma once

#include <string>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/world_resource.h"
#include "server/transport/security.h"

namespace aureole::kubernetes {

inline constexpr char kControlName[] = "aureole-control", kRoleLabel[] = "aureole.dev/role", kLeader[] = "leader";

// Its image is that of the servers, and the volumes that its --tls and --tokens are in are theirs, too.
PodDefaults DefaultsOf(const Json& pod, const SecurityOptions& security);

// Where the Service is reached, IP:port: in a cluster without DNS, too. FailedPrecondition when it has no address.
absl::StatusOr<std::string> AddressOf(ApiClient* client, const std::string& service);

// The Service finds the leader by a label: puts it on our Pod, and takes it from all others. Idempotent; call it now
// and then.
absl::Status LabelLeader(ApiClient* client, const std::string& pod);

}  // namespace aureole::kubernetes
