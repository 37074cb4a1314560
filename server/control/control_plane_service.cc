#include "server/control/control_plane_service.h"

#include <algorithm>
#include <utility>

#include "server/transport/error_status.h"

namespace aureole {
namespace {

// Where the caller is to blame, the message begins with the field, if it is one's.
grpc::Status Answer(const absl::Status& s) {
  if (s.ok()) return grpc::Status::OK;
  const auto code = static_cast<grpc::StatusCode>(s.code());
  const std::string message(s.message());
  if (absl::IsUnavailable(s)) return Refusal(code, v1::NO_REGION, "", message);
  if (absl::IsResourceExhausted(s)) return Refusal(code, v1::BUSY, "", message);
  const size_t colon = message.find(": ");
  const std::string field = colon == std::string::npos ? "" : message.substr(0, colon);
  return Refusal(code, v1::BAD_VALUE, field, colon == std::string::npos ? message : message.substr(colon + 2));
}

grpc::ServerUnaryReactor* Finish(grpc::CallbackServerContext* context, const grpc::Status& status) {
  grpc::ServerUnaryReactor* reactor = context->DefaultReactor();
  reactor->Finish(status);
  return reactor;
}

}  // namespace

ControlPlaneService::ControlPlaneService(LayoutDesk& desk, EventLog& events, CheckpointDesk& checkpoints,
                                         std::function<RunStatus()> status)
    : desk_(desk), events_(events), checkpoints_(checkpoints), status_(std::move(status)) {}

grpc::ServerUnaryReactor* ControlPlaneService::GetWorld(grpc::CallbackServerContext* context,
                                                        const v1::GetControlledWorldRequest*,
                                                        v1::ControlledWorld* response) {
  const LayoutDesk::State state = desk_.state();
  const RunStatus status = status_();
  response->set_name(desk_.world().name);
  response->set_layout_epoch(state.now.epoch);
  response->set_changing(state.changing);
  response->set_refused(state.refused);
  for (size_t i = 0; i < std::max(status.regions.size(), state.now.regions.size()); ++i) {
    v1::ControlledRegion* out = response->add_regions();
    const auto r = static_cast<RegionId>(i);
    out->set_member(std::binary_search(state.now.members.begin(), state.now.members.end(), r));
    if (i < state.now.regions.size()) {
      const Rect& rect = state.now.regions[i];
      out->set_min_x(rect.min_x);
      out->set_max_x(rect.max_x);
      out->set_min_z(rect.min_z);
      out->set_max_z(rect.max_z);
    }
    if (i >= status.regions.size()) continue;
    const RegionStatus& from = status.regions[i];
    out->set_endpoint(from.endpoint);
    out->set_incarnation(from.incarnation);
    out->set_tick(from.report.tick());
    out->set_bodies(from.report.bodies());
    out->set_awake(from.report.awake());
    out->set_frame_mean_ms(from.frame.mean_ms());
    out->set_frame_p99_ms(from.frame.p99_ms());
  }
  return Finish(context, grpc::Status::OK);
}

grpc::ServerWriteReactor<v1::ControlEvent>* ControlPlaneService::WatchEvents(grpc::CallbackServerContext* context,
                                                                             const v1::WatchEventsRequest* request) {
  return events_.Watch(context, *request);
}

grpc::ServerUnaryReactor* ControlPlaneService::ResizeLayout(grpc::CallbackServerContext* context,
                                                            const v1::ResizeLayoutRequest* request,
                                                            v1::ResizeLayoutResponse*) {
  return Finish(context, Answer(desk_.Resize(request->columns(), request->rows() == 0 ? 1 : request->rows())));
}

grpc::ServerUnaryReactor* ControlPlaneService::DrainRegion(grpc::CallbackServerContext* context,
                                                           const v1::DrainRegionRequest* request,
                                                           v1::DrainRegionResponse*) {
  return Finish(context, Answer(desk_.Drain(request->region())));
}

grpc::ServerUnaryReactor* ControlPlaneService::SaveCheckpoint(grpc::CallbackServerContext* context,
                                                              const v1::SaveCheckpointRequest* request,
                                                              v1::SaveCheckpointResponse* response) {
  grpc::ServerUnaryReactor* reactor = context->DefaultReactor();
  checkpoints_.Ask(request->copied(), [reactor, response](const absl::Status& s, const v1::SaveCheckpointResponse& r) {
    *response = r;
    reactor->Finish(Answer(s));
  });
  return reactor;
}

}  // namespace aureole
