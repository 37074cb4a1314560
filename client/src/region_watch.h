// The stream of one region: opened, read, acknowledged, and opened again when it was lost.
#pragma once

#include <condition_variable>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <thread>

#include <grpcpp/client_context.h>

#include "aureole/client.h"
#include "aureole/v1/simulation.grpc.pb.h"
#include "client/src/replica_decoder.h"

namespace aureole::client {

class RegionWatch {
 public:
  struct Events {
    // After the decoder has taken a frame; `fresh`: the first complete state of a new stream.
    std::function<void(const v1::ReplicaFrame&, const ReplicaDecoder&, bool fresh)> frame;
    std::function<void(bool up)> connection;
  };
  // Both are called on the watch's own thread.
  RegionWatch(std::string endpoint, Access access, v1::StreamReplicasRequest request, Events events);
  ~RegionWatch();

  const std::string& endpoint() const { return endpoint_; }
  // Changes the view, the rate or the level of detail.
  void Want(const v1::StreamReplicasRequest& request);

 private:
  using Stream = grpc::ClientReaderWriter<v1::PlayRequest, v1::PlayResponse>;

  void Run();
  void Read(Stream* stream, const v1::StreamReplicasRequest& request);

  const std::string endpoint_;
  const Access access_;
  const Events events_;
  std::mutex mutex_;
  std::condition_variable ended_changed_;
  v1::StreamReplicasRequest request_;
  bool changed_ = false;  // request_ is not yet told
  std::shared_ptr<grpc::ClientContext> context_;
  bool ended_ = false;
  std::thread thread_;
};

}  // namespace aureole::client
