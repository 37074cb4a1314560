#include "server/transport/play_stream.h"

#include <algorithm>
#include <utility>

#include <grpcpp/impl/codegen/proto_utils.h>

#include "server/transport/error_status.h"
#include "server/transport/wire.h"

namespace aureole {
PlayStream::PlayStream(grpc::CallbackServerContext* context, InputService* inputs, ReplicaPublisher* replicas,
                       int64_t tick_us)
    : inputs_(inputs), replicas_(replicas), tick_us_(tick_us), context_(context) {}

std::shared_ptr<PlayStream> PlayStream::Start(grpc::CallbackServerContext* context, InputService* inputs,
                                              ReplicaPublisher* replicas, int64_t tick_us) {
  std::shared_ptr<PlayStream> out(new PlayStream(context, inputs, replicas, tick_us));
  out->self_ = out;
  const bool serving = inputs->Enter(out.get());
  const std::lock_guard lock(out->mutex_);
  if (serving) {
    out->Continue();
  } else {
    out->Finally(NoRegion());
  }
  return out;
}

ReplicaSubscriber::State PlayStream::Poll() {
  const std::lock_guard lock(mutex_);
  if (ended_ || done_) return State::kGone;
  const Clock::time_point now = Clock::now();
  if (writing_ && now - written_at_ > kLongestSilence) context_->TryCancel();
  if (acknowledges_ && unacknowledged_.size() >= kMostUnacknowledged) {
    if (now - behind_since_ <= kLongestSilence) return State::kBusy;
    Finally(Refusal(grpc::StatusCode::RESOURCE_EXHAUSTED, v1::TOO_SLOW, "acknowledged_tick",
                    "must follow the frames; read faster, or ask for fewer or smaller frames"));
    return State::kGone;
  }
  return writing_ ? State::kBusy : State::kReady;
}

bool PlayStream::Send(const grpc::Slice& frame, Tick tick) {
  const std::lock_guard lock(mutex_);
  if (ended_ || done_ || writing_) return false;  // it may be writing outcomes
  const grpc::Slice slices[] = {grpc::Slice(FieldHead(v1::PlayResponse::kFrameFieldNumber, frame.size())), frame};
  out_ = grpc::ByteBuffer(slices, 2);
  unacknowledged_.push_back(tick);
  if (!acknowledges_ && unacknowledged_.size() > kMostUnacknowledged) unacknowledged_.pop_front();
  if (unacknowledged_.size() == kMostUnacknowledged) behind_since_ = Clock::now();
  writing_ = true;
  written_at_ = Clock::now();
  StartWrite(&out_);
  return true;
}

std::shared_ptr<const ReplicaRequest> PlayStream::TakeRequest() {
  const std::lock_guard lock(mutex_);
  return std::exchange(wanted_, nullptr);
}

void PlayStream::Settle(const InputOutcome& outcome) {
  const std::lock_guard lock(mutex_);
  --waiting_;
  AddOutcome(outcome.name.second, outcome.tick, outcome.bodies, ReasonOf(outcome));
}

void PlayStream::Reject(v1::Reason reason, uint64_t sequence) {
  const std::lock_guard lock(mutex_);
  AddOutcome(sequence, 0, 0, reason);
}

void PlayStream::End(const grpc::Status& status) {
  const std::lock_guard lock(mutex_);
  Finally(status);
}

void PlayStream::OnReadDone(bool ok) {
  if (!ok) {
    const std::lock_guard lock(mutex_);
    reading_ = false;
    all_read_ = true;
    return Continue();
  }
  const Path path = (Path() / "request")[requests_++];
  v1::PlayRequest request;
  grpc::Status refusal;
  bool joins = false;
  if (!grpc::SerializationTraits<v1::PlayRequest>::Deserialize(&in_, &request).ok()) {
    refusal = Refusal(grpc::StatusCode::INVALID_ARGUMENT, v1::BAD_VALUE, path.str(), "must be a PlayRequest");
  }
  if (refusal.ok() && request.has_watch()) refusal = TakeWatch(path / "watch", request.watch(), &joins);
  if (refusal.ok() && request.has_inputs()) refusal = TakeInputs(path / "inputs", request.inputs());
  std::shared_ptr<PlayStream> self;
  {
    const std::lock_guard lock(mutex_);
    reading_ = false;
    self = self_;
    if (request.acknowledged_tick() != 0) Acknowledge(request.acknowledged_tick());
    if (!refusal.ok()) Finally(refusal);
    Continue();
  }
  if (self == nullptr) return;
  if (joins) {
    replicas_->Join(self);
  } else if (request.has_watch()) {
    replicas_->Wake();
  }
}

// `joins`: it is the first wish of this stream.
grpc::Status PlayStream::TakeWatch(const Path& path, const v1::StreamReplicasRequest& request, bool* joins) {
  SpecCheck check;
  ReplicaRequest wanted = ReplicaRequest::Read(path, request, tick_us_, &check);
  const std::lock_guard lock(mutex_);
  if (watching_ && wanted.format != format_) {
    check.Fail(path, "must keep precision, velocities and encoding; open another stream to change them", v1::CONFLICT);
  }
  if (!check.ok()) return Refusal(check);
  *joins = !std::exchange(watching_, true);
  format_ = wanted.format;
  wanted_ = std::make_shared<const ReplicaRequest>(std::move(wanted));
  return grpc::Status::OK;
}

grpc::Status PlayStream::TakeInputs(const Path& path, const v1::ImpulseBatch& batch) {
  if (!rights_.Has(v1::Token::PUSH)) return NoRight(path.str(), v1::Token::PUSH);
  const auto all = static_cast<size_t>(batch.impulse_size());
  {
    // Before they are offered: outcomes may come at once.
    const std::lock_guard lock(mutex_);
    waiting_ += all;
  }
  size_t taken = 0;
  const grpc::Status refusal = inputs_->Offer(this, path, batch, &client_, &taken);
  const std::lock_guard lock(mutex_);
  waiting_ -= all - taken;
  return refusal;
}

void PlayStream::OnWriteDone(bool ok) {
  const std::lock_guard lock(mutex_);
  writing_ = false;
  if (!ok) Finally(grpc::Status::CANCELLED);
  if (ended_ && !std::exchange(finished_, true)) return Finish(verdict_);
  Continue();
}

void PlayStream::OnCancel() { End(grpc::Status::CANCELLED); }

void PlayStream::OnDone() {
  inputs_->Leave(this);
  std::shared_ptr<PlayStream> self;  // goes after the lock
  const std::lock_guard lock(mutex_);
  done_ = true;
  self = std::move(self_);
}

// No further write; finishes now, or when the write in flight is done.
void PlayStream::Finally(const grpc::Status& status) {
  if (std::exchange(ended_, true)) return;
  verdict_ = status;
  if (!writing_ && !std::exchange(finished_, true)) Finish(verdict_);
}

void PlayStream::Continue() {
  if (ended_ || done_) return;
  if (!writing_ && outcomes_.sequence_size() > 0) WriteOutcomes();
  // The client has said all: it is done when it has all outcomes, and wants no frames.
  if (all_read_ && waiting_ == 0 && !writing_) return Finally(grpc::Status::OK);
  const bool behind = waiting_ + static_cast<size_t>(outcomes_.sequence_size()) >= InputService::kMostWaiting;
  if (!reading_ && !all_read_ && !behind) {
    reading_ = true;
    StartRead(&in_);
  }
}

void PlayStream::WriteOutcomes() {
  v1::PlayResponse response;
  response.mutable_outcomes()->Swap(&outcomes_);
  outcomes_.Clear();
  const grpc::Slice bytes(response.SerializeAsString());
  out_ = grpc::ByteBuffer(&bytes, 1);
  writing_ = true;
  written_at_ = Clock::now();
  StartWrite(&out_);
}

void PlayStream::AddOutcome(uint64_t sequence, Tick tick, int64_t bodies, v1::Reason reason) {
  if (ended_ || done_) return;
  outcomes_.add_sequence(sequence);
  outcomes_.add_tick(tick);
  outcomes_.add_bodies(bodies);
  outcomes_.add_reason(reason);
  Continue();
}

void PlayStream::Acknowledge(Tick tick) {
  if (!std::exchange(acknowledges_, true)) behind_since_ = Clock::now();
  while (!unacknowledged_.empty() && unacknowledged_.front() <= tick) unacknowledged_.pop_front();
}

}  // namespace aureole
