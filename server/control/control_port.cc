#include "server/control/control_port.h"

#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/health_check_service_interface.h>

namespace aureole {
namespace {

// Half of the time after which they ask: gRPC's default, five minutes, would take them for a flood.
constexpr int kLeastPingMs = 2500;

}  // namespace

void ConfigureControlPort(grpc::ServerBuilder* builder) {
  grpc::EnableDefaultHealthCheckService(true);
  grpc::reflection::InitProtoReflectionServerBuilderPlugin();
  builder->AddChannelArgument(GRPC_ARG_ALLOW_REUSEPORT, 0);  // else a second control plane would share the port
  builder->AddChannelArgument(GRPC_ARG_HTTP2_MIN_RECV_PING_INTERVAL_WITHOUT_DATA_MS, kLeastPingMs);
}

}  // namespace aureole
