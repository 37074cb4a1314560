// Tells people what happened to an object: `kubectl describe` shows it. Nobody waits for it, and nothing depends on it.
#pragma once

#include <condition_variable>
#include <mutex>
#include <string>
#include <thread>

#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/event_series.h"

namespace aureole::kubernetes {

// Totals since the start.
struct EventStats {
  int64_t recorded = 0;
  int64_t written = 0;  // requests that succeeded; fewer than recorded when events repeat
  int64_t failed = 0;   // requests that did not
  int64_t dropped = 0;  // events that were never written: too many at a time, or given up
};

class EventRecorder {
 public:
  struct Options {
    std::string component, instance;           // EventSeries
    std::chrono::milliseconds interval{1000};  // at least, between two writes of one series
  };

  // Starts a thread. `client` must outlive it.
  EventRecorder(ApiClient* client, Options options);
  // Forgets what is not written yet, within milliseconds; Flush before if that matters.
  ~EventRecorder();
  EventRecorder(const EventRecorder&) = delete;
  EventRecorder& operator=(const EventRecorder&) = delete;

  // Any thread. Costs a look-up, whatever the API server does.
  void Record(Event event);
  // Waits until all is written or given up; false when that takes longer.
  bool Flush(std::chrono::milliseconds at_most);
  EventStats stats() const;

 private:
  void Run(const std::stop_token& stop);
  void Write(const EventWrite& write, const std::stop_token& stop);

  ApiClient* const client_;
  const Options options_;
  mutable std::mutex mutex_;
  std::condition_variable_any changed_;
  EventSeries series_;
  bool writing_ = false;
  EventStats stats_;
  std::jthread thread_;
};

}  // namespace aureole::kubernetes
