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

// A call that waits for the outcomes of inputs. Both are called with the service's mutex held, and must not call back.
class InputCaller {
 public:
  virtual ~InputCaller() = default;
  virtual void Settle(const InputOutcome& outcome) = 0;
  // An input that was rejected at once; its outcome does not follow.
  virtual void Reject(v1::Reason reason, uint64_t sequence) = 0;
  virtual void End(const grpc::Status& status) = 0;
};

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

  // For calls that bring inputs among others (Play). Between Enter and Leave the caller gets its outcomes, and its end.
  // Enter: false when the server has no region.
  bool Enter(InputCaller* caller);
  void Leave(InputCaller* caller);
  // Offers what is in the batch, up to the first mistake, whose refusal it returns. `*client` is 0 before the first.
  // `taken`: how many outcomes follow.
  grpc::Status Offer(InputCaller* caller, const Path& path, const v1::ImpulseBatch& batch, uint64_t* client,
                     size_t* taken);

  // From here on inputs are taken, for this world.
  void Serve(const v1::WorldSpec& spec, int64_t tick_us);
  // Ends all calls.
  void Stop();

  // From the tick thread: what came since the last call, in order; and what became of it.
  std::vector<Input> Take();
  void Settle(const std::vector<InputOutcome>& outcomes);

 private:
  using Clock = std::chrono::steady_clock;

  template <class Reactor>
  class Call;
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
  grpc::Status OfferLocked(InputCaller* caller, const Path& path, const v1::ImpulseBatch& batch, uint64_t* client,
                           size_t* taken);
  bool Allow(uint64_t client, double inputs);
  void Submit(InputCaller* caller, Input input);
  void Remove(InputCaller* caller);

  std::mutex mutex_;
  std::unique_ptr<Scene> scene_;  // null: not serving
  std::set<InputCaller*> callers_;
  std::vector<Input> queue_;
  // By input, the calls that wait for it; more than one when it was repeated.
  std::multimap<InputName, InputCaller*> waiting_;
  absl::flat_hash_map<uint64_t, Allowance> allowances_;
};

// Why it did not act; unspecified when it did.
v1::Reason ReasonOf(const InputOutcome& outcome);
// Counts rejections by reason, as messages list them.
void AddRejected(v1::Reason reason, uint64_t sequence, google::protobuf::RepeatedPtrField<v1::Rejected>* list);

}  // namespace aureole
