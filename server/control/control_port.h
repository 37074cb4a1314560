// What every port at which region servers join needs, whoever serves it.
#pragma once

#include <grpcpp/server_builder.h>

namespace aureole {

// Health and reflection; the port is this process's alone; and servers may ask every few seconds whether this machine
// is still there. Before the services are registered.
void ConfigureControlPort(grpc::ServerBuilder* builder);

}  // namespace aureole
