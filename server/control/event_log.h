// What has happened to a world, and those who watch it.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <deque>
#include <mutex>
#include <set>
#include <vector>

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include "aureole/v1/control_plane.grpc.pb.h"
#include "server/control/run_event.h"

namespace aureole {

// Thread-safe; no call blocks, but the end.
class EventLog {
 public:
  static constexpr size_t kMostEvents = 10'000, kMostStreams = 64;

  // `kept`: those of earlier control planes of the world, ascending. Keeps the newest `most`.
  explicit EventLog(std::vector<RunEvent> kept = {}, size_t most = kMostEvents);
  // Ends the streams and waits for it; none may come any more.
  ~EventLog();
  EventLog(const EventLog&) = delete;
  EventLog& operator=(const EventLog&) = delete;

  // Tells it to all who watch. Returns it with its sequence.
  RunEvent Add(RunEvent event);
  // A call of WatchEvents.
  grpc::ServerWriteReactor<v1::ControlEvent>* Watch(grpc::CallbackServerContext* context,
                                                    const v1::WatchEventsRequest& request);
  // Ends the streams that are here.
  void End();

 private:
  class Stream;

  const size_t most_;
  std::mutex mutex_;  // guards all below, and the streams
  std::condition_variable left_;
  std::deque<RunEvent> events_;
  uint64_t first_, next_;  // sequences of this control plane
  std::set<Stream*> streams_;
};

}  // namespace aureole
