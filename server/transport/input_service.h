// The inputs of clients (proto/aureole/v1/simulation.proto: ApplyImpulses, SpawnBodies, RemoveBodies) on their way to
// the tick thread, and their outcomes on the way back. The tick thread never waits for a client; a client that sends
// faster than its inputs act is read no further until they have.
#pragma once

#include <chrono>
#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <set>
#include <vector>

#include <absl/container/flat_hash_map.h>
#include <grpcpp/server_context.h>

#include "aureole/v1/simulation.grpc.pb.h"
#include "server/core/live_inputs.h"
#include "server/transport/input_reader.h"
#include "server/transport/world_bodies.h"

namespace aureole {

class InputService {
 public:
  // Outcomes that one stream may wait for.
  static constexpr size_t kMostWaiting = 4096;
  // Inputs in one message, copies of bodies included.
  static constexpr int kMostPerMessage = 1024;

  // From any thread; the calls of clients.
  grpc::ServerReadReactor<v1::ImpulseBatch>* ApplyImpulses(v1::ImpulseSummary* summary);
  grpc::ServerUnaryReactor* SpawnBodies(const v1::SpawnBodiesRequest& request, v1::SpawnBodiesResponse* response);
  grpc::ServerUnaryReactor* RemoveBodies(const v1::RemoveBodiesRequest& request, v1::RemoveBodiesResponse* response);

  // From here on inputs are taken, for this world.
  void Serve(const v1::WorldSpec& spec, int64_t tick_us);
  // Ends all calls.
  void Stop();

  // From the tick thread: what came since the last call, in order; and what became of it.
  std::vector<Input> Take();
  void Settle(const std::vector<InputOutcome>& outcomes);

 private:
  using Clock = std::chrono::steady_clock;

  // A call that waits for outcomes. Guarded by the service's mutex.
  class Caller {
   public:
    virtual ~Caller() = default;
    virtual void Settle(const InputOutcome& outcome) = 0;
    virtual void End(const grpc::Status& status) = 0;
  };
  class ImpulseStream;
  class BodiesCall;
  class SpawnCall;
  class RemoveCall;

  // What reads bodies of this world.
  struct Scene {
    Scene(const v1::WorldSpec& spec, int64_t tick);
    const int64_t tick_us;
    v1::WorldSpec names;  // the named shapes and materials only
    SpecCheck check;      // of the message that is being read
    BodyReader reader;
    ClientLimits limits;
  };
  // What a client may still send; refills with time.
  struct Allowance {
    double left = 0;
    Clock::time_point at;
  };

  // All hold the mutex.
  bool Allow(uint64_t client, double inputs);
  void Submit(Caller* caller, Input input);
  void Remove(Caller* caller);

  std::mutex mutex_;
  std::unique_ptr<Scene> scene_;  // null: not serving
  std::set<Caller*> callers_;
  std::vector<Input> queue_;
  // By input, the calls that wait for it; more than one when it was repeated.
  std::multimap<InputName, Caller*> waiting_;
  absl::flat_hash_map<uint64_t, Allowance> allowances_;
};

// Counts rejections by reason, as messages list them.
void AddRejected(v1::Reason reason, uint64_t sequence, google::protobuf::RepeatedPtrField<v1::Rejected>* list);

}  // namespace aureole
