// One Play call: replicas and outcomes out, views, inputs and acknowledgements in. One write in flight; outcomes go
// first, and a client that does not take them is read no further.
#pragma once

#include <chrono>
#include <deque>
#include <memory>
#include <mutex>

#include <grpcpp/server_context.h>
#include <grpcpp/support/byte_buffer.h>
#include <grpcpp/support/server_callback.h>

#include "server/transport/guard.h"
#include "server/transport/input_service.h"
#include "server/transport/replica_publisher.h"

namespace aureole {

class PlayStream final : public grpc::ServerBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer>,
                         public ReplicaSubscriber,
                         public InputCaller {
 public:
  // Frames that may be on the way to a client that acknowledges.
  static constexpr size_t kMostUnacknowledged = 8;
  static constexpr std::chrono::seconds kLongestSilence{10};

  // The reactor of a call, with the rights of its caller. It lives until the call is done and the publisher has let go
  // of it.
  static std::shared_ptr<PlayStream> Start(grpc::CallbackServerContext* context, InputService* inputs,
                                           ReplicaPublisher* replicas, int64_t tick_us);

  State Poll() override;
  bool Send(const grpc::Slice& frame, Tick tick) override;
  std::shared_ptr<const ReplicaRequest> TakeRequest() override;
  void Settle(const InputOutcome& outcome) override;
  void Reject(v1::Reason reason, uint64_t sequence) override;
  void End(const grpc::Status& status) override;

 private:
  using Clock = std::chrono::steady_clock;

  PlayStream(grpc::CallbackServerContext* context, InputService* inputs, ReplicaPublisher* replicas, int64_t tick_us);
  void OnReadDone(bool ok) override;
  void OnWriteDone(bool ok) override;
  void OnCancel() override;
  void OnDone() override;

  grpc::Status TakeWatch(const Path& path, const v1::StreamReplicasRequest& request, bool* joins);
  grpc::Status TakeInputs(const Path& path, const v1::ImpulseBatch& batch);

  // All hold mutex_.
  void Finally(const grpc::Status& status);
  void Continue();
  void WriteOutcomes();
  void AddOutcome(uint64_t sequence, Tick tick, int64_t bodies, v1::Reason reason);
  void Acknowledge(Tick tick);

  InputService* const inputs_;
  ReplicaPublisher* const replicas_;
  const int64_t tick_us_;
  const Rights rights_ = RightsOfCaller();
  uint64_t client_ = 0;  // of reads only
  int requests_ = 0;     // likewise
  grpc::ByteBuffer in_;

  std::mutex mutex_;
  grpc::CallbackServerContext* const context_;  // valid until done_
  std::shared_ptr<PlayStream> self_;            // until done_
  std::shared_ptr<const ReplicaRequest> wanted_;
  bool watching_ = false;
  CellFormat format_;
  std::deque<Tick> unacknowledged_;
  bool acknowledges_ = false;
  Clock::time_point behind_since_;
  v1::InputOutcomes outcomes_;
  size_t waiting_ = 0;  // for outcomes
  grpc::ByteBuffer out_;
  Clock::time_point written_at_;
  grpc::Status verdict_;
  bool reading_ = false, all_read_ = false, writing_ = false, ended_ = false, finished_ = false, done_ = false;
};

}  // namespace aureole
