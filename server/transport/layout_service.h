// Where the servers of a world are, and how this one does (proto/aureole/v1/simulation.proto: WatchLayout). The tick
// thread never waits for a client.
#pragma once

#include <atomic>
#include <chrono>
#include <memory>
#include <mutex>
#include <set>
#include <vector>

#include <grpcpp/support/server_callback.h>

#include "aureole/v1/control.pb.h"
#include "aureole/v1/simulation.pb.h"
#include "server/core/region.h"

namespace aureole {

class LayoutService {
 public:
  // Boxes of one status, and how old they may be.
  static constexpr size_t kMostAuras = 4096;
  static constexpr size_t kMostStreams = 64;       // with status
  static constexpr size_t kMostLayoutOnly = 4096;  // and without
  static constexpr std::chrono::milliseconds kAuraEvery{200};

  // From any thread; the calls of clients.
  grpc::ServerWriteReactor<v1::LayoutUpdate>* Watch(grpc::CallbackServerContext* context,
                                                    const v1::WatchLayoutRequest& request);

  // From here on this is the world.
  void Serve(const v1::GetWorldResponse& world);
  // The layout has changed; all who watch are told.
  void Follow(const v1::GetWorldResponse& world);
  // Ends all calls.
  void Stop();

  // From the tick thread, after each tick. Costs nothing unless somebody watches auras.
  void AfterTick(const Region& region);
  // From the tick thread.
  void Report(const v1::Report& report, int64_t clients, int64_t client_bytes_sent);

 private:
  using Clock = std::chrono::steady_clock;
  class Stream;

  std::mutex mutex_;
  bool serving_ = false;
  v1::GetWorldResponse world_;
  std::set<Stream*> streams_, layout_only_;
  std::atomic<int> want_auras_ = 0;  // how many streams

  // Of the tick thread.
  Clock::time_point auras_at_;
  std::vector<WireBox> auras_;
};

}  // namespace aureole
