#include "client/src/push_sender.h"

#include <algorithm>
#include <chrono>
#include <cstdio>

#include "client/src/channel.h"
#include "client/src/convert.h"

namespace aureole::client {
namespace {

constexpr size_t kMostPerMessage = 256;
constexpr std::chrono::milliseconds kBackoff(100);

}  // namespace

PushSender::PushSender(std::vector<std::string> endpoints, uint64_t client, Access access)
    : client_(client), access_(std::move(access)), endpoints_(std::move(endpoints)), thread_([this] { Run(); }) {}

PushSender::~PushSender() {
  {
    const std::lock_guard lock(mutex_);
    ended_ = true;
    if (context_ != nullptr) context_->TryCancel();
  }
  changed_.notify_all();
  thread_.join();
}

void PushSender::Follow(std::vector<std::string> endpoints) {
  const std::lock_guard lock(mutex_);
  endpoints_ = std::move(endpoints);
  const bool there = std::find(endpoints_.begin(), endpoints_.end(), serving_) != endpoints_.end();
  if (!there && context_ != nullptr) context_->TryCancel();
}

void PushSender::Send(const Push& push) {
  {
    const std::lock_guard lock(mutex_);
    pending_.push_back({++last_sequence_, push});
    ++unsent_;
  }
  changed_.notify_all();
}

bool PushSender::Flush(double timeout_seconds) {
  std::unique_lock lock(mutex_);
  return changed_.wait_for(lock, std::chrono::duration<double>(timeout_seconds), [this] { return pending_.empty(); });
}

PushCounts PushSender::counts() const {
  const std::lock_guard lock(mutex_);
  PushCounts out = counts_;
  out.waiting = static_cast<int64_t>(pending_.size());
  out.reasons.assign(reasons_.begin(), reasons_.end());
  return out;
}

void PushSender::Cut() {
  const std::lock_guard lock(mutex_);
  if (context_ != nullptr) context_->TryCancel();
}

// A stream is opened when there is something to send, and kept.
void PushSender::Run() {
  for (size_t server = 0;; ++server) {
    std::string endpoint;
    {
      std::unique_lock lock(mutex_);
      changed_.wait(lock, [this] { return ended_ || !pending_.empty(); });
      if (ended_) return;
      context_ = std::make_shared<grpc::ClientContext>();
      stream_ended_ = false;
      unsent_ = pending_.size();
      endpoint = serving_ = endpoints_[server % endpoints_.size()];
    }
    Serve(endpoint);
    std::unique_lock lock(mutex_);
    context_ = nullptr;
    changed_.wait_for(lock, kBackoff, [this] { return ended_; });
  }
}

void PushSender::Serve(const std::string& endpoint) {
  const auto stub = v1::Simulation::NewStub(ChannelTo(endpoint, access_));
  const auto stream = stub->Play(context_.get());
  std::thread reader([this, &stream] { ReadOutcomes(stream.get()); });
  Sent sent;
  while (true) {
    v1::PlayRequest request;
    {
      std::unique_lock lock(mutex_);
      changed_.wait(lock, [this] { return ended_ || stream_ended_ || unsent_ > 0; });
      if (ended_ || stream_ended_) break;
      if (sent.empty()) request.mutable_inputs()->set_client(client_);
      sent.emplace_back();
      const size_t n = std::min(unsent_, kMostPerMessage);
      const size_t first = pending_.size() - unsent_;
      for (size_t i = first; i < first + n; ++i) {
        sent.back().push_back(pending_[i].sequence);
        *request.mutable_inputs()->add_impulse() = ImpulseOf(pending_[i].push, pending_[i].sequence);
      }
      unsent_ -= n;
    }
    if (!stream->Write(request)) break;
  }
  reader.join();  // ends with the stream, or with the cancellation of ~PushSender
  Refuse(sent, stream->Finish());
}

void PushSender::ReadOutcomes(grpc::ClientReaderWriter<v1::PlayRequest, v1::PlayResponse>* stream) {
  v1::PlayResponse response;
  while (stream->Read(&response)) Settle(response.outcomes());
  {
    const std::lock_guard lock(mutex_);
    stream_ended_ = true;
  }
  changed_.notify_all();
}

void PushSender::Settle(const v1::InputOutcomes& outcomes) {
  {
    const std::lock_guard lock(mutex_);
    for (int i = 0; i < outcomes.sequence_size(); ++i) {
      const auto it = std::lower_bound(pending_.begin(), pending_.end(), outcomes.sequence(i),
                                       [](const Pending& p, uint64_t s) { return p.sequence < s; });
      if (it == pending_.end() || it->sequence != outcomes.sequence(i)) continue;  // it was repeated
      pending_.erase(it);
      if (outcomes.reason(i) == v1::REASON_UNSPECIFIED) {
        ++counts_.applied;
        counts_.bodies += outcomes.bodies(i);
      } else {
        ++counts_.rejected;
        ++reasons_[v1::Reason_Name(outcomes.reason(i))];
      }
    }
    unsent_ = std::min(unsent_, pending_.size());
  }
  changed_.notify_all();
}

// A push that cannot be is not sent again.
void PushSender::Refuse(const Sent& sent, const grpc::Status& status) {
  const Status why = FromGrpc(status);
  if (status.error_code() == grpc::StatusCode::UNAUTHENTICATED ||
      status.error_code() == grpc::StatusCode::PERMISSION_DENIED) {
    for (const std::vector<uint64_t>& message : sent) {
      for (uint64_t sequence : message) Reject(sequence, why.reason);
    }
    return;
  }
  if (status.error_code() != grpc::StatusCode::INVALID_ARGUMENT) return;
  size_t request = 0, impulse = 0;
  if (std::sscanf(why.field.c_str(), "request[%zu].inputs.impulse[%zu]", &request, &impulse) == 2 &&
      request < sent.size() && impulse < sent[request].size()) {
    Reject(sent[request][impulse], why.reason);
  }
}

void PushSender::Reject(uint64_t sequence, const std::string& reason) {
  {
    const std::lock_guard lock(mutex_);
    if (std::erase_if(pending_, [sequence](const Pending& p) { return p.sequence == sequence; }) == 0) return;
    ++counts_.rejected;
    ++reasons_[reason];
  }
  changed_.notify_all();
}

}  // namespace aureole::client
