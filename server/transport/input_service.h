// The inputs of clients (proto/aureole/v1/simulation.proto: ApplyImpulses, SpawnBodies, RemoveBodies) on their way to
// the tick thread, and their outcomes on the way back. The tick thread never waits for a client; a client that sends
// faster than its inputs act is read no further until they have.
#pragma once

#include <chrono>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <mutex>
#include <set>
#include <vector>

#include <absl/container/flat_hash_map.h>
#include <grpcpp/server_context.h>

#include "aureole/v1/simulation.grpc.pb.h"
#include "server/core/live_inputs.h"
#include "server/transport/input_messages.h"

namespace aureole {

// A call that waits for the outcomes of inputs. Both are called with the service's mutex held, and must not call back.
class InputCaller {
 public:
  virtual ~InputCaller() = default;
  virtual void Settle(const InputOutcome& outcome) = 0;
  // An input that was rejected at once; its outcome does not follow.
  virtual void Reject(v1::Reason reason, uint64_t sequence) = 0;
  virtual void End(const grpc::Status& status) = 0;

 private:
  friend class InputService;
  int64_t open_ = 0;  // inputs that the service knows to wait
};

class InputService {
 public:
  // Outcomes that one stream may wait for.
  static constexpr size_t kMostWaiting = 4096;
  // What may wait for the tick thread, of all clients: by CostOf, and bytes.
  static constexpr int64_t kMostQueued = 1 << 16, kMostQueuedBytes = 16 << 20;

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

  // From the tick thread: the next ones of what came, in order, about as many as it tells in a tick; and what became of
  // them.
  std::vector<Input> Take();
  void Settle(const std::vector<InputOutcome>& outcomes);
  // From the tick thread: what any server's clients sent and takes effect.
  void Hear(const std::vector<Input>& delivered);

 private:
  using Clock = std::chrono::steady_clock;

  template <class Reactor>
  class Call;
  class ImpulseStream;
  class BodiesCall;
  class SpawnCall;
  class RemoveCall;

  // What a client may still send; refills with time.
  struct Allowance {
    double left = 0;
    double repeats = 0;  // likewise, of what was taken before
    Clock::time_point at;
  };
  struct Queued {
    Input input;
    int64_t bytes = 0;
  };
  template <class Request>
  using Reader = std::vector<Input> (*)(const InputScene& scene, const Request& request, SpecCheck* check);

  template <class Request>
  grpc::ServerUnaryReactor* Start(BodiesCall* call, const Request& request, Reader<Request> read);
  std::shared_ptr<const InputScene> scene();

  // All hold the mutex.
  grpc::Status Offer(InputCaller* caller, std::vector<Input> inputs, size_t* taken);
  bool IsRepeat(uint64_t client, uint64_t sequence) const;
  bool Allow(uint64_t client, double inputs, bool repeat);
  bool HasRoom(int64_t cost) const;
  void Note(uint64_t client, uint64_t sequence);
  void Submit(InputCaller* caller, Input input);
  void Remove(InputCaller* caller);

  std::mutex mutex_;
  std::shared_ptr<const InputScene> scene_;  // null: not serving
  std::set<InputCaller*> callers_;
  std::deque<Queued> queue_;
  int64_t queued_ = 0, queued_bytes_ = 0;
  // By input, the calls that wait for it; more than one when it was repeated.
  std::multimap<InputName, InputCaller*> waiting_;
  absl::flat_hash_map<uint64_t, Allowance> allowances_;
  Clock::time_point purged_at_;                       // of those that are full again
  absl::flat_hash_map<uint64_t, uint64_t> greatest_;  // sequences that any server has taken, by client
};

// Why it did not act; unspecified when it did.
v1::Reason ReasonOf(const InputOutcome& outcome);
// Counts rejections by reason, as messages list them.
void AddRejected(v1::Reason reason, uint64_t sequence, google::protobuf::RepeatedPtrField<v1::Rejected>* list);

}  // namespace aureole
