// One StreamReplicas call. Frames come serialised; there is one write in flight at most, so a slow reader gets fewer.
#pragma once

#include <chrono>
#include <memory>
#include <mutex>

#include <grpcpp/server_context.h>
#include <grpcpp/support/byte_buffer.h>
#include <grpcpp/support/server_callback.h>

#include "server/transport/replica_publisher.h"

namespace aureole {

class ReplicaStream final : public grpc::ServerWriteReactor<grpc::ByteBuffer>, public ReplicaSubscriber {
 public:
  // A reader that takes nothing for so long is cut off.
  static constexpr std::chrono::seconds kLongestWrite{10};

  // The reactor of a call. It lives until the call is done and the publisher has let go of it.
  static std::shared_ptr<ReplicaStream> Start(grpc::CallbackServerContext* context, ReplicaRequest request);

  State Poll() override;
  bool Send(const grpc::Slice& frame, Tick tick) override;
  std::shared_ptr<const ReplicaRequest> TakeRequest() override;
  void End(const grpc::Status& status) override;

 private:
  using Clock = std::chrono::steady_clock;

  ReplicaStream(grpc::CallbackServerContext* context, ReplicaRequest request);
  void OnWriteDone(bool ok) override;
  void OnCancel() override;
  void OnDone() override;

  std::mutex mutex_;
  grpc::CallbackServerContext* const context_;  // valid until done_
  std::shared_ptr<const ReplicaRequest> request_;
  std::shared_ptr<ReplicaStream> self_;  // until done_
  grpc::ByteBuffer out_;
  Clock::time_point written_at_;
  grpc::Status verdict_;
  bool writing_ = false, ended_ = false, done_ = false;
};

// A call that is refused at once.
template <class Message>
class RefusedStream final : public grpc::ServerWriteReactor<Message> {
 public:
  explicit RefusedStream(const grpc::Status& status) { this->Finish(status); }
  void OnDone() override { delete this; }
};

}  // namespace aureole
