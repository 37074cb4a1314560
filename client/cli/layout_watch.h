// The status of all regions of a running world, as they tell it (WatchLayout), while regions come and go.
#pragma once

#include <condition_variable>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <thread>

#include <grpcpp/grpcpp.h>

#include "aureole/v1/simulation.grpc.pb.h"
#include "client/src/layout_follower.h"
#include "server/control/run_status.h"

namespace aureole {

class LayoutWatch {
 public:
  // Asks this server for the others and begins to listen to all. Null when it does not answer; then `error` says why.
  static std::unique_ptr<LayoutWatch> Open(const std::string& server, std::string* error);
  ~LayoutWatch();

  // The newest layout.
  v1::GetWorldResponse world() const;
  // What was told last. A region whose stream has ended has `left` set, with the reason, until it tells more; one that
  // is not in the layout is no member.
  RunStatus status() const;

 private:
  // Of one region; guarded by the mutex.
  struct Listener {
    std::string endpoint;
    std::shared_ptr<grpc::ClientContext> context;
    bool ended = false;
    std::thread thread;
  };

  LayoutWatch(const std::string& server, const v1::GetWorldResponse& world);
  void Follow(const v1::GetWorldResponse& world);
  void Listen(size_t region, Listener* listener);
  void Take(size_t region, const v1::RegionStatus& status);
  void End(std::unique_ptr<Listener> listener);

  mutable std::mutex mutex_;
  std::condition_variable ended_changed_;
  v1::GetWorldResponse world_;
  RunStatus status_;
  std::map<size_t, std::unique_ptr<Listener>> listeners_;  // the map: of the follower's thread, once there is one
  std::unique_ptr<client::LayoutFollower> follower_;
};

}  // namespace aureole
