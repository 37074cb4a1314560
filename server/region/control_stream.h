// The region server's side of the control stream (control.proto), and the one queue of events that the server's main
// thread waits on.
#pragma once

#include <chrono>
#include <condition_variable>
#include <deque>
#include <memory>
#include <mutex>
#include <string>

#include <grpcpp/client_context.h>
#include <grpcpp/security/credentials.h>

#include "aureole/v1/control.grpc.pb.h"

namespace aureole {

struct Event {
  enum class Kind { kMessage, kControlLost, kSignal, kFenced, kGone };
  Kind kind = Kind::kMessage;
  v1::ToRegion message;
  std::string reason;    // why the stream ended
  bool refused = false;  // by a control plane that will not have this server: there is no use in coming again
  int signal = 0;
};

// Unbounded, but fed by people and a control plane only. Thread-safe.
class EventQueue {
 public:
  void Push(Event event);
  // Waits for the next.
  Event Pop();
  // At most until `deadline`; nothing came: false.
  bool PopUntil(std::chrono::steady_clock::time_point deadline, Event* event);

 private:
  std::mutex mutex_;
  std::condition_variable pushed_;
  std::deque<Event> events_;
};

// A connection to a control plane, shared with no other channel, over which streams are opened one after another.
class ControlChannel {
 public:
  // `world`: which of the control plane's worlds the server is for; empty: its only one.
  ControlChannel(const std::string& address, const std::shared_ptr<grpc::ChannelCredentials>& credentials,
                 std::string world);

 private:
  friend class ControlStream;
  const std::string world_;
  std::unique_ptr<v1::Control::Stub> stub_;
};

// One Join stream. Messages and the end of the stream become events.
class ControlStream final : public grpc::ClientBidiReactor<v1::FromRegion, v1::ToRegion> {
 public:
  // Starts to connect and says `hello`.
  ControlStream(ControlChannel* channel, v1::Hello hello, EventQueue* events);
  // Cancels what is left and waits for the end.
  ~ControlStream() override;

  // Any thread; never waits for the network. False: dropped, since the stream has ended.
  bool Send(v1::FromRegion message);
  // Ends the stream soon, without a word. Any thread.
  void Cancel() { context_.TryCancel(); }
  // Says goodbye after everything that was sent, and waits for the end of the stream, at most a second. `left`: the
  // region has left its world.
  void Close(const std::string& reason, bool left = false);

 private:
  void OnReadDone(bool ok) override;
  void OnWriteDone(bool ok) override;
  void OnDone(const grpc::Status& status) override;
  void Pump();

  EventQueue* const events_;
  grpc::ClientContext context_;
  v1::ToRegion in_;  // only touched by reads

  std::mutex mutex_;
  std::condition_variable done_changed_;
  std::deque<v1::FromRegion> queue_;
  v1::FromRegion out_;  // in flight
  bool writing_ = false, ended_ = false, closing_ = false, done_ = false;
};

}  // namespace aureole
