#include "server/region/control_stream.h"
#include "server/core/limits.h"

#include <chrono>
#include <utility>

#include <grpcpp/create_channel.h>

#include "server/transport/server_certificate.h"

namespace aureole {
namespace {

// Of a call to Control.Join (control.proto).
constexpr char kWorldMetadata[] = "aureole-world";

}  // namespace

void EventQueue::Push(Event event) {
  {
    const std::lock_guard lock(mutex_);
    events_.push_back(std::move(event));
  }
  pushed_.notify_one();
}

Event EventQueue::Pop() {
  std::unique_lock lock(mutex_);
  pushed_.wait(lock, [this] { return !events_.empty(); });
  Event event = std::move(events_.front());
  events_.pop_front();
  return event;
}

bool EventQueue::PopUntil(std::chrono::steady_clock::time_point deadline, Event* event) {
  std::unique_lock lock(mutex_);
  if (!pushed_.wait_until(lock, deadline, [this] { return !events_.empty(); })) return false;
  *event = std::move(events_.front());
  events_.pop_front();
  return true;
}

ControlChannel::ControlChannel(const std::string& address, const std::shared_ptr<grpc::ChannelCredentials>& credentials,
                               std::string world)
    : world_(std::move(world)) {
  grpc::ChannelArguments arguments;
  arguments.SetInt(GRPC_ARG_ENABLE_HTTP_PROXY, 0);
  arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);  // a connection of its own
  arguments.SetSslTargetNameOverride(kServerName);
  arguments.SetMaxReceiveMessageSize(limits::kMaxWorldFileBytes);  // an assignment holds the whole world
  // Who lost its control plane wants the next one soon.
  arguments.SetInt(GRPC_ARG_INITIAL_RECONNECT_BACKOFF_MS, 200);
  arguments.SetInt(GRPC_ARG_MIN_RECONNECT_BACKOFF_MS, 500);
  arguments.SetInt(GRPC_ARG_MAX_RECONNECT_BACKOFF_MS, 1000);
  // The machine of the control plane may have gone without a word.
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, 5000);
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, 5000);
  arguments.SetInt(GRPC_ARG_HTTP2_MAX_PINGS_WITHOUT_DATA, 0);
  stub_ = v1::Control::NewStub(grpc::CreateCustomChannel(address, credentials, arguments));
}

ControlStream::ControlStream(ControlChannel* channel, v1::Hello hello, EventQueue* events) : events_(events) {
  if (!channel->world_.empty()) context_.AddMetadata(kWorldMetadata, channel->world_);
  channel->stub_->async()->Join(&context_, this);
  AddHold();  // writes come from outside of gRPC's callbacks; released when nothing is read any more
  StartRead(&in_);
  v1::FromRegion first;
  *first.mutable_hello() = std::move(hello);
  Send(std::move(first));
  StartCall();
}

ControlStream::~ControlStream() {
  context_.TryCancel();
  std::unique_lock lock(mutex_);
  done_changed_.wait(lock, [this] { return done_; });
}

bool ControlStream::Send(v1::FromRegion message) {
  const std::lock_guard lock(mutex_);
  if (ended_ || closing_) return false;
  queue_.push_back(std::move(message));
  Pump();
  return true;
}

void ControlStream::Close(const std::string& reason, bool left) {
  std::unique_lock lock(mutex_);
  if (!closing_) {
    closing_ = true;
    v1::Goodbye* goodbye = queue_.emplace_back().mutable_goodbye();
    goodbye->set_reason(reason);
    goodbye->set_left(left);
    Pump();
  }
  done_changed_.wait_for(lock, std::chrono::seconds(1), [this] { return done_; });
}

// Holds the mutex.
void ControlStream::Pump() {
  if (ended_ || writing_) return;
  if (queue_.empty()) {
    if (closing_) {
      ended_ = true;
      StartWritesDone();
    }
    return;
  }
  out_ = std::move(queue_.front());
  queue_.pop_front();
  writing_ = true;
  StartWrite(&out_);
}

void ControlStream::OnReadDone(bool ok) {
  if (ok) {
    Event event;
    event.message = std::move(in_);
    events_->Push(std::move(event));
    in_.Clear();
    StartRead(&in_);
    return;
  }
  {
    const std::lock_guard lock(mutex_);
    ended_ = true;
  }
  RemoveHold();
}

void ControlStream::OnWriteDone(bool ok) {
  const std::lock_guard lock(mutex_);
  writing_ = false;
  if (ok) Pump();
}

void ControlStream::OnDone(const grpc::Status& status) {
  Event event;
  event.kind = Event::Kind::kControlLost;
  event.reason = status.ok() ? "the control plane has ended the stream" : status.error_message();
  switch (status.error_code()) {
    case grpc::StatusCode::INVALID_ARGUMENT:
    case grpc::StatusCode::FAILED_PRECONDITION:
    case grpc::StatusCode::ALREADY_EXISTS:
    case grpc::StatusCode::UNAUTHENTICATED:
    case grpc::StatusCode::PERMISSION_DENIED:
      event.refused = true;
      break;
    default:
      break;
  }
  events_->Push(std::move(event));
  const std::lock_guard lock(mutex_);
  done_ = true;
  done_changed_.notify_all();
}

}  // namespace aureole
