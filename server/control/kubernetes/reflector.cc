#include "server/control/kubernetes/reflector.h"

#include <algorithm>
#include <utility>

#include "server/control/kubernetes/api_status.h"
#include "server/control/kubernetes/backoff.h"

namespace aureole::kubernetes {
namespace {

// The way to the server, or what we may there, is not as it should be: that leaves our version as good as it was.
bool LeavesVersion(const absl::Status& status) {
  return absl::IsUnavailable(status) || absl::IsFailedPrecondition(status) || absl::IsUnauthenticated(status) ||
         absl::IsPermissionDenied(status);
}

}  // namespace

Reflector::Reflector(ApiClient* client, Options options, Wakeup* wakeup)
    : client_(client),
      options_(std::move(options)),
      wakeup_(wakeup),
      thread_([this](const std::stop_token& stop) { Run(stop); }) {}

Reflector::~Reflector() { Stop(); }

void Reflector::Stop() {
  thread_.request_stop();
  if (thread_.joinable()) thread_.join();
}

bool Reflector::synced() const {
  const std::lock_guard lock(mutex_);
  return synced_;
}

std::vector<Change> Reflector::Take() {
  const std::lock_guard lock(mutex_);
  return cache_.Take();
}

Objects Reflector::objects() const {
  const std::lock_guard lock(mutex_);
  return cache_.objects();
}

absl::Status Reflector::health() const {
  const std::lock_guard lock(mutex_);
  return health_;
}

ReflectorStats Reflector::stats() const {
  const std::lock_guard lock(mutex_);
  return stats_;
}

void Reflector::Run(const std::stop_token& stop) {
  Backoff backoff(options_.first_pause, options_.longest_pause);
  int failures = 0;  // in a row
  while (!stop.stop_requested()) {
    bool moved = false;
    const bool listing = version_.empty();
    const absl::Status status = listing ? ListAll(stop) : WatchOnce(stop, &moved);
    if (stop.stop_requested()) return;
    Settle(status);
    if (moved) {
      backoff.Reset();
      failures = 0;
    }
    if (status.ok() && (listing || moved)) continue;
    // Also after a watch that ended well, but soon: a server that does so must not be asked in a tight loop.
    if (!status.ok() && (!LeavesVersion(status) || ++failures >= kMostFailures)) {
      version_.clear();
      failures = 0;
    }
    const std::chrono::milliseconds asked = RetryAfterOf(status).value_or(std::chrono::seconds(0));
    if (!Pause(stop, std::max(asked, backoff.Next()))) return;
  }
}

absl::Status Reflector::ListAll(const std::stop_token& stop) {
  CallOptions options;
  options.stop = stop;
  options.attempts = 1;  // the loop above repeats
  absl::StatusOr<ObjectList> list = client_->List(options_.resource, options_.selection, options);
  if (!list.ok()) return list.status();
  {
    const std::lock_guard lock(mutex_);
    if (absl::Status s = cache_.Replace(std::move(list->items)); !s.ok()) return s;
    synced_ = true;
    ++stats_.lists;
  }
  version_ = list->resource_version;
  wakeup_->Notify();
  return absl::OkStatus();
}

absl::Status Reflector::WatchOnce(const std::stop_token& stop, bool* moved) {
  {
    const std::lock_guard lock(mutex_);
    ++stats_.watches;
  }
  const auto began = std::chrono::steady_clock::now();
  const WatchOptions options{
      .timeout = options_.watch_timeout, .grace = options_.watch_grace, .stop = stop, .opened = [this] {
        Settle(absl::OkStatus());
      }};
  absl::Status status = client_->Watch(options_.resource, options_.selection, version_, options, [&](WatchEvent event) {
    *moved = true;
    return TakeEvent(std::move(event));
  });
  if (status.ok() && std::chrono::steady_clock::now() - began >= std::chrono::seconds(1)) *moved = true;
  return status;
}

absl::Status Reflector::TakeEvent(WatchEvent event) {
  std::string version = TextAt(event.object, {"metadata", "resourceVersion"});
  if (version.empty()) return absl::DataLossError("an event without metadata.resourceVersion");
  const bool bookmark = event.kind == WatchEvent::Kind::kBookmark;
  bool changed = false;
  {
    const std::lock_guard lock(mutex_);
    if (absl::Status s = cache_.Apply(std::move(event)); !s.ok()) return s;
    ++(bookmark ? stats_.bookmarks : stats_.events);
    changed = cache_.has_changes();
  }
  version_ = std::move(version);
  if (changed) wakeup_->Notify();
  return absl::OkStatus();
}

void Reflector::Settle(const absl::Status& status) {
  const std::lock_guard lock(mutex_);
  health_ = status;
  if (status.ok()) return;
  ++(absl::IsOutOfRange(status) ? stats_.gone : stats_.failures);
}

}  // namespace aureole::kubernetes
