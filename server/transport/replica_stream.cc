#include "server/transport/replica_stream.h"

#include <utility>

namespace aureole {

ReplicaStream::ReplicaStream(grpc::CallbackServerContext* context, ReplicaRequest request)
    : context_(context), request_(std::make_shared<const ReplicaRequest>(std::move(request))) {}

std::shared_ptr<ReplicaStream> ReplicaStream::Start(grpc::CallbackServerContext* context, ReplicaRequest request) {
  std::shared_ptr<ReplicaStream> out(new ReplicaStream(context, std::move(request)));
  out->self_ = out;
  return out;
}

ReplicaSubscriber::State ReplicaStream::Poll() {
  const std::lock_guard lock(mutex_);
  if (ended_ || done_) return State::kGone;
  if (!writing_) return State::kReady;
  if (Clock::now() - written_at_ > kLongestWrite) context_->TryCancel();
  return State::kBusy;
}

bool ReplicaStream::Send(const grpc::Slice& frame, Tick) {
  const std::lock_guard lock(mutex_);
  if (ended_ || done_ || writing_) return false;
  out_ = grpc::ByteBuffer(&frame, 1);
  writing_ = true;
  written_at_ = Clock::now();
  StartWrite(&out_);
  return true;
}

std::shared_ptr<const ReplicaRequest> ReplicaStream::TakeRequest() {
  const std::lock_guard lock(mutex_);
  return std::exchange(request_, nullptr);
}

// No further write; finishes now, or when the write in flight is done.
void ReplicaStream::End(const grpc::Status& status) {
  const std::lock_guard lock(mutex_);
  if (std::exchange(ended_, true)) return;
  verdict_ = status;
  if (!writing_) Finish(verdict_);
}

void ReplicaStream::OnWriteDone(bool ok) {
  const std::lock_guard lock(mutex_);
  writing_ = false;
  if (!ended_ && ok) return;
  if (!std::exchange(ended_, true)) verdict_ = grpc::Status::CANCELLED;
  Finish(verdict_);
}

void ReplicaStream::OnCancel() { End(grpc::Status::CANCELLED); }

void ReplicaStream::OnDone() {
  std::shared_ptr<ReplicaStream> self;  // goes after the lock
  const std::lock_guard lock(mutex_);
  done_ = true;
  self = std::move(self_);
}

}  // namespace aureole
