// What a region goes on from when its own volume has nothing for it (proto/aureole/v1/copy.proto).
#pragma once

#include <chrono>
#include <memory>
#include <string>

#include <absl/status/statusor.h>
#include <grpcpp/security/credentials.h>

#include "server/region/copy_sender.h"
#include "server/region/journal.h"

namespace aureole {

// What the keeper at `endpoint` has, and fences there all that came before this incarnation. A keeper that is not there
// yet, which may be recovered itself, is asked again for so long. The keeper's error, or DataLoss.
absl::StatusOr<Journal::Recovered> FetchCopy(const CopyIdentity& identity, RegionId keeper, const std::string& endpoint,
                                             const std::shared_ptr<grpc::ChannelCredentials>& credentials,
                                             std::chrono::milliseconds at_most);

}  // namespace aureole
