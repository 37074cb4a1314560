// The library's own types to the interface's messages and back.
#pragma once

#include <grpcpp/support/status.h>

#include "aureole/client.h"
#include "aureole/v1/simulation.pb.h"

namespace aureole::client {

Status FromGrpc(const grpc::Status& status);
Look LookFrom(const v1::BodyDescription& description);
World WorldFrom(const v1::GetWorldResponse& response);
v1::StreamReplicasRequest RequestOf(const WatchOptions& options);
v1::Impulse ImpulseOf(const Push& push, uint64_t sequence);
v1::Body BodyOf(const NewBody& body);

}  // namespace aureole::client
