// Watches every server of a world that runs as a client does, each for as long as it is there, and measures the longest
// time in which one of them told nothing new: the longest stop of the world.
#pragma once

#include <grpcpp/grpcpp.h>

#include <chrono>
#include <list>
#include <mutex>
#include <set>
#include <string>
#include <thread>

#include "aureole/v1/simulation.grpc.pb.h"
#include "server/control/run_status.h"

namespace aureole {

class FrameWatcher {
 public:
  ~FrameWatcher() { End(); }

  // Call it often, before End.
  void Look(const RunStatus& status) {
    if (status.stage != Stage::kRunning) return;
    for (const RegionStatus& r : status.regions) {
      if (!r.member || !r.ready || r.report.tick() == 0 || !watched_.emplace(r.endpoint, r.incarnation).second)
        continue;
      Stream* stream = &streams_.emplace_back();
      stream->thread = std::thread([this, stream, endpoint = r.endpoint] { Watch(stream, endpoint); });
    }
  }
  // What servers do not tell any more is no stop from here on.
  void End() {
    for (Stream& stream : streams_) stream.context.TryCancel();
    for (Stream& stream : streams_) {
      if (stream.thread.joinable()) stream.thread.join();
    }
  }

  std::chrono::duration<double> longest_stop() const { return longest_; }
  int64_t frames() const { return frames_; }

 private:
  using Clock = std::chrono::steady_clock;
  struct Stream {
    grpc::ClientContext context;
    std::thread thread;
  };

  void Watch(Stream* stream, const std::string& endpoint) {
    const auto stub = v1::Simulation::NewStub(grpc::CreateChannel(endpoint, grpc::InsecureChannelCredentials()));
    v1::StreamReplicasRequest request;
    request.set_rate(60);
    const auto reader = stub->StreamReplicas(&stream->context, request);
    v1::ReplicaFrame frame;
    Clock::time_point last{};
    while (reader->Read(&frame)) {
      const Clock::time_point now = Clock::now();
      const std::lock_guard lock(mutex_);
      if (last != Clock::time_point{}) longest_ = std::max(longest_, now - last);
      last = now;
      ++frames_;
    }
    reader->Finish();
  }

  std::set<std::pair<std::string, uint64_t>> watched_;  // endpoint, incarnation
  std::list<Stream> streams_;
  std::mutex mutex_;
  Clock::duration longest_{};
  int64_t frames_ = 0;
};

}  // namespace aureole
