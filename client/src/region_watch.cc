#include "client/src/region_watch.h"

#include <algorithm>
#include <chrono>
#include <utility>

#include <grpcpp/create_channel.h>
#include <grpcpp/support/channel_arguments.h>

namespace aureole::client {
namespace {

constexpr std::chrono::milliseconds kMinBackoff(50), kMaxBackoff(1000);

std::shared_ptr<grpc::Channel> Connect(const std::string& endpoint) {
  grpc::ChannelArguments arguments;
  // Frames that lie on the way are old frames: the window stays small.
  arguments.SetInt(GRPC_ARG_HTTP2_BDP_PROBE, 0);
  arguments.SetMaxReceiveMessageSize(-1);
  return grpc::CreateCustomChannel(endpoint, grpc::InsecureChannelCredentials(), arguments);
}

}  // namespace

RegionWatch::RegionWatch(std::string endpoint, v1::StreamReplicasRequest request, Events events)
    : endpoint_(std::move(endpoint)),
      events_(std::move(events)),
      request_(std::move(request)),
      thread_([this] { Run(); }) {}

RegionWatch::~RegionWatch() {
  {
    const std::lock_guard lock(mutex_);
    ended_ = true;
    if (context_ != nullptr) context_->TryCancel();
  }
  ended_changed_.notify_all();
  thread_.join();
}

void RegionWatch::Want(const v1::StreamReplicasRequest& request) {
  const std::lock_guard lock(mutex_);
  request_ = request;
  v1::PlayRequest message;
  *message.mutable_watch() = request;
  if (stream_ != nullptr) stream_->Write(message);
}

void RegionWatch::Run() {
  const std::shared_ptr<grpc::Channel> channel = Connect(endpoint_);
  const auto stub = v1::Simulation::NewStub(channel);
  std::chrono::milliseconds backoff = kMinBackoff;
  while (true) {
    std::unique_ptr<Stream> stream;
    {
      const std::lock_guard lock(mutex_);
      if (ended_) return;
      context_ = std::make_shared<grpc::ClientContext>();
      stream = stub->Play(context_.get());
      v1::PlayRequest message;
      *message.mutable_watch() = request_;
      stream->Write(message);
      stream_ = stream.get();
    }
    Read(stream.get());
    {
      const std::lock_guard lock(mutex_);
      stream_ = nullptr;
      context_->TryCancel();
    }
    const grpc::Status status = stream->Finish();
    events_.connection(false);
    std::unique_lock lock(mutex_);
    context_ = nullptr;
    backoff = status.error_code() == grpc::StatusCode::UNAVAILABLE ? std::min(2 * backoff, kMaxBackoff) : kMinBackoff;
    ended_changed_.wait_for(lock, backoff, [this] { return ended_; });
  }
}

void RegionWatch::Read(Stream* stream) {
  ReplicaDecoder decoder(request_.precision(), request_.velocities());
  bool up = false, complete = false;
  std::string error;
  v1::PlayResponse response;
  while (stream->Read(&response)) {
    if (!response.has_frame()) continue;
    if (!std::exchange(up, true)) events_.connection(true);
    if (!decoder.Apply(response.frame(), &error)) return;  // begins anew
    const bool fresh = !complete && !response.frame().more();
    complete |= fresh;
    events_.frame(response.frame(), decoder, fresh);
    v1::PlayRequest acknowledge;
    acknowledge.set_acknowledged_tick(decoder.tick());
    const std::lock_guard lock(mutex_);
    if (!stream->Write(acknowledge)) return;
  }
}

}  // namespace aureole::client
