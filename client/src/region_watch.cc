#include "client/src/region_watch.h"

#include <algorithm>
#include <chrono>
#include <utility>

#include <grpcpp/support/channel_arguments.h>

#include "client/src/channel.h"

namespace aureole::client {
namespace {

constexpr std::chrono::milliseconds kMinBackoff(50), kMaxBackoff(1000);

std::shared_ptr<grpc::Channel> Connect(const std::string& endpoint, const Access& access) {
  grpc::ChannelArguments arguments;
  // Frames that lie on the way are old frames: the window stays small.
  arguments.SetInt(GRPC_ARG_HTTP2_BDP_PROBE, 0);
  arguments.SetMaxReceiveMessageSize(-1);
  return ChannelTo(endpoint, access, std::move(arguments));
}

}  // namespace

RegionWatch::RegionWatch(std::string endpoint, Access access, v1::StreamReplicasRequest request, Events events)
    : endpoint_(std::move(endpoint)),
      access_(std::move(access)),
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
  changed_ = true;
}

void RegionWatch::Run() {
  const std::shared_ptr<grpc::Channel> channel = Connect(endpoint_, access_);
  const auto stub = v1::Simulation::NewStub(channel);
  std::chrono::milliseconds backoff = kMinBackoff;
  while (true) {
    std::shared_ptr<grpc::ClientContext> context;
    v1::PlayRequest first;
    {
      const std::lock_guard lock(mutex_);
      if (ended_) return;
      context = context_ = std::make_shared<grpc::ClientContext>();
      *first.mutable_watch() = request_;
      changed_ = false;
    }
    const std::unique_ptr<Stream> stream = stub->Play(context.get());
    if (stream->Write(first)) Read(stream.get(), first.watch());
    context->TryCancel();
    const grpc::Status status = stream->Finish();
    {
      const std::lock_guard lock(mutex_);
      context_ = nullptr;
      if (ended_) return;
    }
    events_.connection(false);
    std::unique_lock lock(mutex_);
    backoff = status.error_code() == grpc::StatusCode::UNAVAILABLE ? std::min(2 * backoff, kMaxBackoff) : kMinBackoff;
    ended_changed_.wait_for(lock, backoff, [this] { return ended_; });
  }
}

// Writes are of this thread alone and wait for nobody else: a new wish goes with the next acknowledgement.
void RegionWatch::Read(Stream* stream, const v1::StreamReplicasRequest& request) {
  ReplicaDecoder decoder(request.precision(), request.velocities());
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
    v1::PlayRequest answer;
    answer.set_acknowledged_tick(decoder.tick());
    {
      const std::lock_guard lock(mutex_);
      if (std::exchange(changed_, false)) *answer.mutable_watch() = request_;
    }
    if (!stream->Write(answer)) return;
  }
}

}  // namespace aureole::client
