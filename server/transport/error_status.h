// The one way in which a call of a client is refused (proto/aureole/v1/error.proto).
#pragma once

#include <string>

#include <grpcpp/support/status.h>

#include "aureole/v1/error.pb.h"
#include "server/transport/spec_check.h"

namespace aureole {

// With the reason, the field and the remedy in the message and in the details.
grpc::Status Refusal(grpc::StatusCode code, v1::Reason reason, const std::string& field, const std::string& remedy);
// INVALID_ARGUMENT with the first mistake. Precondition: !check.ok().
grpc::Status Refusal(const SpecCheck& check);
// UNAVAILABLE, NO_REGION.
grpc::Status NoRegion();
grpc::Status RegionGivenUp();

}  // namespace aureole
