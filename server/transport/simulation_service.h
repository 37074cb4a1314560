// What clients see of this region (proto/aureole/v1/simulation.proto), first version: whole states at a requested rate.
//
// The tick thread publishes; it never waits for a client, and while nobody watches it pays one comparison per tick.
#pragma once

#include <atomic>
#include <chrono>
#include <mutex>
#include <set>

#include <grpcpp/server_context.h>

#include "aureole/v1/control.pb.h"
#include "aureole/v1/simulation.grpc.pb.h"
#include "server/core/region.h"
#include "server/core/world.h"
#include "server/transport/input_service.h"

namespace aureole {

// The shape of a dynamic body as the world file says it.
v1::Shape ShapeToProto(const Shape& shape);

class SimulationService final : public v1::Simulation::CallbackService {
 public:
  SimulationService();
  ~SimulationService() override;

  grpc::ServerUnaryReactor* GetWorld(grpc::CallbackServerContext* context, const v1::GetWorldRequest* request,
                                     v1::GetWorldResponse* response) override;
  grpc::ServerWriteReactor<v1::Replicas>* StreamReplicas(grpc::CallbackServerContext* context,
                                                         const v1::StreamReplicasRequest* request) override;

  grpc::ServerReadReactor<v1::ImpulseBatch>* ApplyImpulses(grpc::CallbackServerContext* context,
                                                           v1::ImpulseSummary* response) override;

  grpc::ServerUnaryReactor* SpawnBodies(grpc::CallbackServerContext* context, const v1::SpawnBodiesRequest* request,
                                        v1::SpawnBodiesResponse* response) override;
  grpc::ServerUnaryReactor* RemoveBodies(grpc::CallbackServerContext* context, const v1::RemoveBodiesRequest* request,
                                         v1::RemoveBodiesResponse* response) override;

  // What clients do to the world.
  InputService& inputs() { return inputs_; }

  // From here on this region is served.
  void Serve(const v1::Assignment& assignment, const World& world);
  // Ends all streams. Publish is not called after it.
  void Stop();
  // The state after a tick; from the tick thread. Cost: nothing when no stream is due, else linear in the bodies.
  void Publish(const Region& region, int64_t bodies);

 private:
  class Watcher;

  InputService inputs_;
  std::atomic<int> watching_ = 0;  // size of watchers_
  std::atomic<Tick> tick_ = 0;
  std::atomic<int64_t> bodies_ = 0;
  mutable std::mutex mutex_;
  bool serving_ = false;
  v1::GetWorldResponse world_;
  std::set<Watcher*> watchers_;
};

}  // namespace aureole
