#include "server/control/event_log.h"

#include <algorithm>
#include <chrono>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/transport/error_status.h"
#include "server/transport/message_stream.h"

namespace aureole {
namespace {

int64_t UnixUs(std::chrono::system_clock::time_point t) {
  return std::chrono::duration_cast<std::chrono::microseconds>(t.time_since_epoch()).count();
}

}  // namespace

// One call. It has no queue: it reads the log at its own pace.
class EventLog::Stream final : public MessageStream<v1::ControlEvent> {
 public:
  Stream(EventLog* log, grpc::CallbackServerContext* context, const v1::WatchEventsRequest& request)
      : MessageStream(&log->mutex_, context),
        log_(log),
        after_(request.after_sequence()),
        last_(request.follow() ? UINT64_MAX : log->next_ - 1) {}

  using MessageStream::Continue;

 private:
  bool Next(v1::ControlEvent* out) override {
    const auto event = std::upper_bound(log_->events_.begin(), log_->events_.end(), after_,
                                        [](uint64_t sequence, const RunEvent& e) { return sequence < e.sequence; });
    if (event == log_->events_.end() || event->sequence > last_) {
      if (last_ != UINT64_MAX) End(grpc::Status::OK);
      return false;
    }
    out->Clear();
    out->set_sequence(event->sequence);
    out->set_unix_us(UnixUs(event->time));
    out->set_kind(event->kind);
    out->set_warning(IsWarning(event->kind));
    if (event->region != kNoRegion) out->set_region(event->region);
    out->set_text(event->what);
    // Those of one control plane have sequences without gaps.
    const uint64_t expected = std::max(after_ + 1, log_->first_);
    if (event->sequence > expected) out->set_missed(static_cast<int64_t>(event->sequence - expected));
    after_ = event->sequence;
    return true;
  }
  void Leave() override {
    log_->streams_.erase(this);
    log_->left_.notify_all();
  }

  EventLog* const log_;
  uint64_t after_;
  const uint64_t last_;
};

// Without a store nobody knows the sequences of the control planes before, but they have begun earlier.
EventLog::EventLog(std::vector<RunEvent> kept, size_t most)
    : most_(most), events_(kept.begin(), kept.end()), first_(UnixUs(std::chrono::system_clock::now())) {
  while (events_.size() > most_) events_.pop_front();
  if (!events_.empty()) first_ = std::max(first_, events_.back().sequence + 1);
  next_ = first_;
}

EventLog::~EventLog() {
  End();
  std::unique_lock lock(mutex_);
  left_.wait(lock, [this] { return streams_.empty(); });
}

RunEvent EventLog::Add(RunEvent event) {
  const std::lock_guard lock(mutex_);
  event.sequence = next_++;
  events_.push_back(event);
  if (events_.size() > most_) events_.pop_front();
  for (Stream* s : streams_) s->Continue();
  return event;
}

grpc::ServerWriteReactor<v1::ControlEvent>* EventLog::Watch(grpc::CallbackServerContext* context,
                                                            const v1::WatchEventsRequest& request) {
  const std::lock_guard lock(mutex_);
  auto* stream = new Stream(this, context, request);
  streams_.insert(stream);
  if (streams_.size() > kMostStreams) {
    stream->End(
        Refusal(grpc::StatusCode::RESOURCE_EXHAUSTED, v1::BUSY, "",
                absl::StrCat("the control plane tells its events to at most ", kMostStreams, " callers; try later")));
  } else {
    stream->Continue();
  }
  return stream;
}

void EventLog::End() {
  const std::lock_guard lock(mutex_);
  for (Stream* s : streams_) {
    s->End({grpc::StatusCode::UNAVAILABLE, "the run is over, or its control plane leaves; come again if it runs"});
  }
}

}  // namespace aureole
