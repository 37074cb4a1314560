// A call that streams messages to a client: one write in flight, and what is next is asked for when it has ended.
#pragma once

#include <chrono>
#include <mutex>
#include <utility>

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

namespace aureole {

// Guarded by its service's mutex; deletes itself when the call is done. All but the reactions are called with the mutex
// held.
template <class Message>
class MessageStream : public grpc::ServerWriteReactor<Message> {
 public:
  // A reader that takes nothing for so long is cut off.
  static constexpr std::chrono::seconds kLongestWrite{10};

  // No further write; finishes now, or when the write in flight is done.
  void End(const grpc::Status& status) {
    if (std::exchange(ended_, true)) return;
    verdict_ = status;
    if (!writing_) this->Finish(verdict_);
  }
  bool ended() const { return ended_; }

 protected:
  MessageStream(std::mutex* mutex, grpc::CallbackServerContext* context) : mutex_(mutex), context_(context) {}

  // The next message; false: there is none yet.
  virtual bool Next(Message* out) = 0;
  // The service forgets it.
  virtual void Leave() = 0;

  // There may be something to write.
  void Continue() {
    if (writing_ && Clock::now() - written_at_ > kLongestWrite) context_->TryCancel();
    if (writing_ || ended_ || !Next(&out_)) return;
    writing_ = true;
    written_at_ = Clock::now();
    this->StartWrite(&out_);
  }

 private:
  using Clock = std::chrono::steady_clock;

  void OnWriteDone(bool ok) final {
    const std::lock_guard lock(*mutex_);
    writing_ = false;
    if (ended_) return this->Finish(verdict_);
    if (!ok) return End(grpc::Status::CANCELLED);
    Continue();
  }
  void OnCancel() final {
    const std::lock_guard lock(*mutex_);
    End(grpc::Status::CANCELLED);
  }
  void OnDone() final {
    {
      const std::lock_guard lock(*mutex_);
      Leave();
    }
    delete this;
  }

  std::mutex* const mutex_;
  grpc::CallbackServerContext* const context_;
  Message out_;
  Clock::time_point written_at_;
  grpc::Status verdict_;
  bool writing_ = false, ended_ = false;
};

}  // namespace aureole
