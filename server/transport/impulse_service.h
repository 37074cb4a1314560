// The impulses of clients (proto/aureole/v1/simulation.proto, ApplyImpulses) on their way to the tick thread, and their
// outcomes on the way back. The tick thread never waits for a client; a client that sends faster than its impulses act
// is read no further until they have.
#pragma once

#include <cstdint>
#include <map>
#include <mutex>
#include <set>
#include <vector>

#include <grpcpp/server_context.h>

#include "aureole/v1/simulation.grpc.pb.h"
#include "server/core/live_inputs.h"

namespace aureole {

class ImpulseService {
 public:
  // Outcomes that one stream may wait for.
  static constexpr size_t kMostWaiting = 4096;

  // From any thread; the call of a client.
  grpc::ServerReadReactor<v1::ImpulseBatch>* Apply(v1::ImpulseSummary* summary);
  void Serve();
  // Ends all streams.
  void Stop();

  // From the tick thread: what came since the last call, in order; and what became of it.
  std::vector<Input> Take();
  void Settle(const std::vector<InputOutcome>& outcomes);

 private:
  class Stream;

  std::mutex mutex_;
  bool serving_ = false;
  std::set<Stream*> streams_;
  std::vector<Input> queue_;
  // By input, the streams that wait for it; more than one when it was repeated.
  std::multimap<InputName, Stream*> waiting_;
};

}  // namespace aureole
