// What recordings are made of (proto/aureole/v1/recording.proto). The tick thread never waits for a reader.
#pragma once

#include <atomic>
#include <memory>
#include <mutex>
#include <set>
#include <vector>

#include <grpcpp/support/server_callback.h>

#include "aureole/v1/recording.grpc.pb.h"
#include "server/core/region.h"

namespace aureole {

class RecordingService final : public v1::Recording::CallbackService {
 public:
  static constexpr size_t kMostWaiting = 64 << 20;  // bytes, the snapshot not counted
  static constexpr size_t kPartBytes = 1 << 20;
  static constexpr size_t kMostStreams = 4;

  grpc::ServerWriteReactor<v1::Recorded>* Record(grpc::CallbackServerContext* context,
                                                 const v1::RecordRequest* request) override;

  // From here on this region is served.
  void Serve(RegionId region, const v1::WorldSpec& world, bool synchronous);
  // Ends all calls.
  void Stop();
  // From the tick thread, after each tick, with the inputs that were delivered in it. Costs nothing while nobody
  // records; else, at ticks with hashes, linear in the region's bodies.
  void AfterTick(const Region& region, const std::vector<Input>& delivered);

 private:
  class Stream;

  std::mutex mutex_;
  bool serving_ = false, synchronous_ = false;
  RegionId region_ = kNoRegion;
  v1::WorldSpec world_;
  std::set<Stream*> streams_;
  std::atomic<int> recorders_ = 0;
  std::atomic<Tick> tick_ = 0;
};

}  // namespace aureole
