#include "server/control/kubernetes/event_recorder.h"

#include <utility>

#include <absl/time/clock.h>

#include "server/control/kubernetes/backoff.h"

namespace aureole::kubernetes {

EventRecorder::EventRecorder(ApiClient* client, Options options)
    : client_(client),
      options_(std::move(options)),
      series_(options_.component, options_.instance),
      thread_([this](const std::stop_token& stop) { Run(stop); }) {}

EventRecorder::~EventRecorder() {
  thread_.request_stop();
  thread_.join();
}

void EventRecorder::Record(Event event) {
  {
    const std::lock_guard lock(mutex_);
    ++stats_.recorded;
    if (!series_.Add(std::move(event), absl::Now())) ++stats_.dropped;
  }
  changed_.notify_all();
}

bool EventRecorder::Flush(std::chrono::milliseconds at_most) {
  std::unique_lock lock(mutex_);
  return changed_.wait_for(lock, at_most, [this] { return series_.waiting() == 0 && !writing_; });
}

EventStats EventRecorder::stats() const {
  const std::lock_guard lock(mutex_);
  return stats_;
}

// Rounds: each writes what waits at its beginning, so that what repeats meanwhile is counted, not written each time.
void EventRecorder::Run(const std::stop_token& stop) {
  while (!stop.stop_requested()) {
    size_t round = 0;
    {
      std::unique_lock lock(mutex_);
      changed_.wait(lock, stop, [this] { return series_.waiting() > 0; });
      round = series_.waiting();
    }
    for (; round > 0 && !stop.stop_requested(); --round) {
      std::optional<EventWrite> write;
      {
        const std::lock_guard lock(mutex_);
        write = series_.Next(absl::Now());
        writing_ = write.has_value();
      }
      if (!write) break;
      Write(*write, stop);
      changed_.notify_all();
    }
    Pause(stop, options_.interval);
  }
}

void EventRecorder::Write(const EventWrite& write, const std::stop_token& stop) {
  const Resource events{"", "v1", "events", write.space};
  CallOptions options;
  options.stop = stop;
  const absl::StatusOr<Json> reply = write.name.empty()
                                         ? client_->Create(events, write.object, options)
                                         : client_->Patch(events, write.name, {.body = write.object}, options);
  const std::lock_guard lock(mutex_);
  writing_ = false;
  if (reply.ok()) {
    ++stats_.written;
    series_.Written(write, TextAt(*reply, {"metadata", "name"}));
    return;
  }
  if (!write.name.empty() && absl::IsNotFound(reply.status())) {
    series_.Gone(write);
    return;
  }
  ++stats_.failed;
  if (!series_.Failed(write)) ++stats_.dropped;
}

}  // namespace aureole::kubernetes
