// A copy of all objects of one kind, kept up to date by a thread of its own: list, then watch; again and again,
// whatever happens to the server and the way to it.
//
// A watch that ends or breaks is taken up after the last version seen (bookmarks too). When the server has forgotten
// that version (410), says what cannot be understood, or has failed kMostFailures times in a row from that version on,
// everything is listed again, and what is gone meanwhile is reported as deleted. Versions are never compared but for
// equality.
#pragma once

#include <chrono>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <absl/status/status.h>

#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/object_cache.h"
#include "server/control/kubernetes/wakeup.h"

namespace aureole::kubernetes {

// Totals since the start.
struct ReflectorStats {
  int64_t lists = 0;    // that succeeded
  int64_t watches = 0;  // begun
  int64_t events = 0;   // taken, bookmarks not among them
  int64_t bookmarks = 0;
  int64_t gone = 0;      // 410, of either form
  int64_t failures = 0;  // of lists and watches, 410 not among them
};

class Reflector {
 public:
  static constexpr int kMostFailures = 5;

  struct Options {
    Resource resource;
    Selection selection = {};
    std::chrono::seconds watch_timeout{300};  // WatchOptions
    std::chrono::milliseconds watch_grace{10000};
    std::chrono::milliseconds first_pause{100}, longest_pause{30000};  // after failures
  };

  // Starts. `client` and `wakeup`, which is notified of each change and of the first list, must outlive it.
  Reflector(ApiClient* client, Options options, Wakeup* wakeup);
  // Stops.
  ~Reflector();
  Reflector(const Reflector&) = delete;
  Reflector& operator=(const Reflector&) = delete;

  // The thread ends within milliseconds, also from within a read that hangs. Idempotent.
  void Stop();

  // Any thread. Until the first list is complete there are no objects and no changes; a later list is seen whole, too.
  bool synced() const;
  // What has changed since the last call; the first time: all that there is, as added.
  std::vector<Change> Take();
  Objects objects() const;
  // Why the copy may be out of date; OK while it is listed and watched.
  absl::Status health() const;
  ReflectorStats stats() const;

 private:
  void Run(const std::stop_token& stop);
  absl::Status ListAll(const std::stop_token& stop);
  absl::Status WatchOnce(const std::stop_token& stop, bool* moved);
  absl::Status TakeEvent(WatchEvent event);
  void Settle(const absl::Status& status);

  ApiClient* const client_;
  const Options options_;
  Wakeup* const wakeup_;
  std::string version_;  // of the thread only; empty: list first

  mutable std::mutex mutex_;
  ObjectCache cache_;
  bool synced_ = false;
  absl::Status health_ = absl::UnavailableError("not listed yet");
  ReflectorStats stats_;
  std::jthread thread_;
};

}  // namespace aureole::kubernetes
