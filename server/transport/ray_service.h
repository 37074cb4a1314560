// Rays of clients (simulation.proto: CastRays), answered on the tick thread between two ticks, a limited number each
// time.
#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <mutex>
#include <vector>

#include <grpcpp/server_context.h>

#include "aureole/v1/simulation.pb.h"
#include "server/core/region.h"
#include "server/transport/spec_check.h"

namespace aureole {

struct ClientRay {
  Vec3 from = Vec3::Zero(), to = Vec3::Zero();
};
// A mistake is told to `check`.
std::vector<ClientRay> ReadRays(const v1::CastRaysRequest& request, SpecCheck* check);

class RayService {
 public:
  static constexpr int kMostPerCall = 256, kMostPerTick = 1024;

  // From any thread; the call of a client.
  grpc::ServerUnaryReactor* Cast(const v1::CastRaysRequest& request, v1::CastRaysResponse* response);
  void Serve();
  // Ends all calls.
  void Stop();
  // After each tick, from the tick thread. Constant time while nobody asks.
  void Answer(const Region& region);

 private:
  class Call;

  std::mutex mutex_;
  bool serving_ = false;
  std::deque<Call*> calls_;  // not answered
  std::atomic<bool> asked_ = false;
};

}  // namespace aureole
