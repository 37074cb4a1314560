#include "server/transport/simulation_service.h"

#include <algorithm>

#include <grpcpp/impl/codegen/proto_utils.h>

#include "server/transport/error_status.h"
#include "server/transport/play_stream.h"
#include "server/transport/replica_stream.h"
#include "server/transport/shape_proto.h"

namespace aureole {

grpc::ServerUnaryReactor* SimulationService::GetWorld(grpc::CallbackServerContext* context,
                                                      const v1::GetWorldRequest* request,
                                                      v1::GetWorldResponse* response) {
  grpc::ServerUnaryReactor* reactor = context->DefaultReactor();
  const std::lock_guard lock(mutex_);
  if (!serving_) {
    reactor->Finish(NoRegion());
    return reactor;
  }
  *response = world_;
  response->set_tick(tick_);
  response->set_bodies(bodies_);
  if (request->scene()) *response->mutable_scene() = scene_;
  reactor->Finish(grpc::Status::OK);
  return reactor;
}

grpc::ServerWriteReactor<grpc::ByteBuffer>* SimulationService::StreamReplicas(grpc::CallbackServerContext* context,
                                                                              const grpc::ByteBuffer* request) {
  using Refused = RefusedStream<grpc::ByteBuffer>;
  grpc::ByteBuffer bytes = *request;
  v1::StreamReplicasRequest message;
  if (!grpc::SerializationTraits<v1::StreamReplicasRequest>::Deserialize(&bytes, &message).ok()) {
    return new Refused(Refusal(grpc::StatusCode::INVALID_ARGUMENT, v1::BAD_VALUE, "",
                               "must be a StreamReplicasRequest; these bytes are none"));
  }
  int64_t tick_us = 0;
  {
    const std::lock_guard lock(mutex_);
    if (!serving_) return new Refused(NoRegion());
    tick_us = world_.tick_us();
  }
  SpecCheck check;
  ReplicaRequest wanted = ReplicaRequest::Read(Path(), message, tick_us, &check);
  if (!check.ok()) return new Refused(Refusal(check));
  const std::shared_ptr<ReplicaStream> stream = ReplicaStream::Start(context, std::move(wanted));
  replicas_.Join(stream);
  return stream.get();
}

grpc::ServerBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer>* SimulationService::Play(
    grpc::CallbackServerContext* context) {
  int64_t tick_us = 0;
  {
    const std::lock_guard lock(mutex_);
    tick_us = world_.tick_us();
  }
  return PlayStream::Start(context, &inputs_, &replicas_, std::max<int64_t>(1, tick_us)).get();
}

grpc::ServerReadReactor<v1::ImpulseBatch>* SimulationService::ApplyImpulses(grpc::CallbackServerContext*,
                                                                            v1::ImpulseSummary* response) {
  return inputs_.ApplyImpulses(response);
}

grpc::ServerUnaryReactor* SimulationService::SpawnBodies(grpc::CallbackServerContext*,
                                                         const v1::SpawnBodiesRequest* request,
                                                         v1::SpawnBodiesResponse* response) {
  return inputs_.SpawnBodies(*request, response);
}

grpc::ServerUnaryReactor* SimulationService::RemoveBodies(grpc::CallbackServerContext*,
                                                          const v1::RemoveBodiesRequest* request,
                                                          v1::RemoveBodiesResponse* response) {
  return inputs_.RemoveBodies(*request, response);
}

grpc::ServerUnaryReactor* SimulationService::CastRays(grpc::CallbackServerContext*, const v1::CastRaysRequest* request,
                                                      v1::CastRaysResponse* response) {
  return rays_.Cast(*request, response);
}

grpc::ServerWriteReactor<v1::LayoutUpdate>* SimulationService::WatchLayout(grpc::CallbackServerContext* context,
                                                                           const v1::WatchLayoutRequest* request) {
  return layout_.Watch(context, *request);
}

void SimulationService::Serve(const v1::Assignment& assignment, const World& world) {
  inputs_.Serve(assignment.world(), world.environment.tick_us);
  rays_.Serve();
  replicas_.Serve(assignment.region(), assignment.layout_epoch(), world.environment.tick_us);
  const std::lock_guard lock(mutex_);
  serving_ = true;
  world_.Clear();
  world_.set_name(world.name);
  world_.set_tick_us(world.environment.tick_us);
  world_.set_region(assignment.region());
  world_.set_layout_epoch(assignment.layout_epoch());
  *world_.mutable_endpoints() = assignment.endpoints();
  SetLayout(world.layout);
  scene_.Clear();
  for (const BodySpec& body : world.environment.fixed) *scene_.Add() = FixedToProto(body);
  layout_.Serve(world_);
}

// Holds the mutex.
void SimulationService::SetLayout(const Layout& layout) {
  world_.clear_layout();
  for (RegionId r = 0; r < layout.size(); ++r) {
    const Rect& rect = layout.rect(r);
    v1::RegionRect* out = world_.add_layout();
    out->set_min_x(rect.min_x);
    out->set_max_x(rect.max_x);
    out->set_min_z(rect.min_z);
    out->set_max_z(rect.max_z);
  }
}

void SimulationService::Follow(const Region& region, const std::vector<std::string>& endpoints) {
  replicas_.Follow(region.layout_epoch());
  const std::lock_guard lock(mutex_);
  const std::string before = world_.SerializeAsString();
  world_.set_layout_epoch(region.layout_epoch());
  world_.clear_endpoints();
  const std::vector<RegionId>& members = region.members();
  for (RegionId r = 0; r < region.layout().size(); ++r) {
    const bool member = std::binary_search(members.begin(), members.end(), r);
    world_.add_endpoints(member && static_cast<size_t>(r) < endpoints.size() ? endpoints[static_cast<size_t>(r)] : "");
  }
  SetLayout(region.layout());
  if (world_.SerializeAsString() != before) layout_.Follow(world_);
}

void SimulationService::Leave() {
  inputs_.Stop();
  rays_.Stop();
}

void SimulationService::Stop() {
  inputs_.Stop();
  rays_.Stop();
  layout_.Stop();
  replicas_.Stop(RegionGivenUp());
  const std::lock_guard lock(mutex_);
  serving_ = false;
}

void SimulationService::AfterTick(Region* region, int64_t bodies) {
  tick_ = region->tick();
  bodies_ = bodies;
  rays_.Answer(*region);
  replicas_.AfterTick(region);
  layout_.AfterTick(*region);
}

void SimulationService::Report(const v1::Report& report) {
  layout_.Report(report, replicas_.subscribers(), replicas_.bytes_sent());
}

}  // namespace aureole
