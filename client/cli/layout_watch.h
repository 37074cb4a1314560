// The status of all regions of a running world, as they tell it (WatchLayout).
#pragma once

#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <grpcpp/grpcpp.h>

#include "aureole/v1/simulation.grpc.pb.h"
#include "server/control/run_status.h"

namespace aureole {

class LayoutWatch {
 public:
  // Asks this server for the others and begins to listen to all. Null when it does not answer; then `error` says why.
  static std::unique_ptr<LayoutWatch> Open(const std::string& server, std::string* error);
  ~LayoutWatch();

  const v1::GetWorldResponse& world() const { return world_; }
  // What was told last. A region whose stream has ended has `left` set, with the reason.
  RunStatus status() const;

 private:
  explicit LayoutWatch(v1::GetWorldResponse world);
  void Listen(size_t region);
  void Take(size_t region, const v1::RegionStatus& status);

  const v1::GetWorldResponse world_;
  mutable std::mutex mutex_;
  RunStatus status_;
  std::vector<std::unique_ptr<grpc::ClientContext>> contexts_;
  std::vector<std::thread> threads_;
};

}  // namespace aureole
