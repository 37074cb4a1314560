// The layout of a running world, as its servers tell it: one stream, to one server at a time, and to another when that
// one is gone or has left.
#pragma once

#include <condition_variable>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <grpcpp/client_context.h>

#include "aureole/client.h"
#include "aureole/v1/simulation.grpc.pb.h"

namespace aureole::client {

// Of the regions that have not left, in order.
std::vector<std::string> EndpointsOf(const v1::GetWorldResponse& world);

class LayoutFollower {
 public:
  using Changed = std::function<void(const v1::GetWorldResponse&)>;

  // `first`: what `server` has told; `server` is asked first, and when none of the layout's own answers. `changed` is
  // called on the follower's own thread with each layout that is newer than the one before; only its name, tick_us,
  // endpoints, layout_epoch and layout are those of the world.
  LayoutFollower(std::string server, v1::GetWorldResponse first, Access access, Changed changed);
  // No call of `changed` comes after it.
  ~LayoutFollower();

 private:
  void Run();
  bool Listen(const std::string& endpoint, grpc::ClientContext* context);
  void Take(const v1::GetWorldResponse& world);

  const std::string server_;
  const Access access_;
  const Changed changed_;
  v1::GetWorldResponse world_;  // of the thread

  std::mutex mutex_;
  std::condition_variable ended_changed_;
  std::shared_ptr<grpc::ClientContext> context_;
  bool ended_ = false;
  std::thread thread_;
};

}  // namespace aureole::client
