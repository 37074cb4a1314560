// What clients see of this region and do to it (proto/aureole/v1/simulation.proto). The tick thread never waits for a
// client, and pays nothing while nobody watches.
#pragma once

#include <atomic>
#include <mutex>
#include <string>
#include <vector>

#include <grpcpp/server_context.h>
#include <grpcpp/support/byte_buffer.h>

#include "aureole/v1/control.pb.h"
#include "aureole/v1/simulation.grpc.pb.h"
#include "server/core/region.h"
#include "server/core/world.h"
#include "server/transport/input_service.h"
#include "server/transport/layout_service.h"
#include "server/transport/ray_service.h"
#include "server/transport/replica_publisher.h"

namespace aureole {

// As generated, but for replicas, which are written as bytes that many calls share.
using SimulationCalls = v1::Simulation::WithCallbackMethod_GetWorld<
    v1::Simulation::WithRawCallbackMethod_StreamReplicas<v1::Simulation::WithRawCallbackMethod_Play<
        v1::Simulation::WithCallbackMethod_ApplyImpulses<v1::Simulation::WithCallbackMethod_SpawnBodies<
            v1::Simulation::WithCallbackMethod_RemoveBodies<v1::Simulation::WithCallbackMethod_CastRays<
                v1::Simulation::WithCallbackMethod_WatchLayout<v1::Simulation::Service>>>>>>>>;

class SimulationService final : public SimulationCalls {
 public:
  grpc::ServerUnaryReactor* GetWorld(grpc::CallbackServerContext* context, const v1::GetWorldRequest* request,
                                     v1::GetWorldResponse* response) override;
  grpc::ServerWriteReactor<grpc::ByteBuffer>* StreamReplicas(grpc::CallbackServerContext* context,
                                                             const grpc::ByteBuffer* request) override;
  grpc::ServerBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer>* Play(grpc::CallbackServerContext* context) override;
  grpc::ServerReadReactor<v1::ImpulseBatch>* ApplyImpulses(grpc::CallbackServerContext* context,
                                                           v1::ImpulseSummary* response) override;
  grpc::ServerUnaryReactor* SpawnBodies(grpc::CallbackServerContext* context, const v1::SpawnBodiesRequest* request,
                                        v1::SpawnBodiesResponse* response) override;
  grpc::ServerUnaryReactor* CastRays(grpc::CallbackServerContext* context, const v1::CastRaysRequest* request,
                                     v1::CastRaysResponse* response) override;
  grpc::ServerUnaryReactor* RemoveBodies(grpc::CallbackServerContext* context, const v1::RemoveBodiesRequest* request,
                                         v1::RemoveBodiesResponse* response) override;

  grpc::ServerWriteReactor<v1::LayoutUpdate>* WatchLayout(grpc::CallbackServerContext* context,
                                                          const v1::WatchLayoutRequest* request) override;

  // What clients do to the world.
  InputService& inputs() { return inputs_; }

  // From here on this region is served.
  void Serve(const v1::Assignment& assignment, const World& world);
  // The layout that is in force in `region`, and where its members are, by region; clients that watch it are told.
  void Follow(const Region& region, const std::vector<std::string>& endpoints);
  // The region has left: what clients want of it is for others, and they are told so.
  void Leave();
  // Ends all calls.
  void Stop();
  // After each tick, from the tick thread; `bodies`: that this region owns. Cost: ReplicaPublisher::AfterTick.
  void AfterTick(Region* region, int64_t bodies);
  // From the tick thread: how it does.
  void Report(const v1::Report& report);

 private:
  InputService inputs_;
  RayService rays_;
  ReplicaPublisher replicas_;
  LayoutService layout_;
  std::atomic<Tick> tick_ = 0;
  std::atomic<int64_t> bodies_ = 0;
  std::mutex mutex_;
  void SetLayout(const Layout& layout);

  bool serving_ = false;
  v1::GetWorldResponse world_;  // without scene
  google::protobuf::RepeatedPtrField<v1::FixedBody> scene_;
};

}  // namespace aureole
