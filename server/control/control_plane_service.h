// What operators do to a running world (proto/aureole/v1/control_plane.proto).
#pragma once

#include <functional>
#include <string>

#include "aureole/v1/control_plane.grpc.pb.h"
#include "server/control/checkpoint_desk.h"
#include "server/control/event_log.h"
#include "server/control/layout_desk.h"
#include "server/control/run_status.h"

namespace aureole {

// Thread-safe; no call blocks. SaveCheckpoint is answered by the desk.
class ControlPlaneService final : public v1::ControlPlane::CallbackService {
 public:
  // All outlive it, and so does what `status` needs, which any thread calls.
  ControlPlaneService(LayoutDesk& desk, EventLog& events, CheckpointDesk& checkpoints,
                      std::function<RunStatus()> status);

  grpc::ServerUnaryReactor* GetWorld(grpc::CallbackServerContext* context, const v1::GetControlledWorldRequest* request,
                                     v1::ControlledWorld* response) override;
  grpc::ServerWriteReactor<v1::ControlEvent>* WatchEvents(grpc::CallbackServerContext* context,
                                                          const v1::WatchEventsRequest* request) override;
  grpc::ServerUnaryReactor* ResizeLayout(grpc::CallbackServerContext* context, const v1::ResizeLayoutRequest* request,
                                         v1::ResizeLayoutResponse* response) override;
  grpc::ServerUnaryReactor* DrainRegion(grpc::CallbackServerContext* context, const v1::DrainRegionRequest* request,
                                        v1::DrainRegionResponse* response) override;
  grpc::ServerUnaryReactor* SaveCheckpoint(grpc::CallbackServerContext* context,
                                           const v1::SaveCheckpointRequest* request,
                                           v1::SaveCheckpointResponse* response) override;

 private:
  LayoutDesk& desk_;
  EventLog& events_;
  CheckpointDesk& checkpoints_;
  const std::function<RunStatus()> status_;
};

}  // namespace aureole
