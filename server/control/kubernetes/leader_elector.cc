#include "server/control/kubernetes/leader_elector.h"

#include <algorithm>
#include <random>
#include <utility>

#include <absl/strings/str_format.h>
#include <absl/time/clock.h>

#include "server/control/kubernetes/backoff.h"

namespace aureole::kubernetes {
namespace {

using Action = LeaderElection::Action;
using std::chrono::milliseconds;

std::string IdentityOf(const std::string& candidate) {
  std::random_device random;
  return absl::StrFormat("%s_%08x%08x", candidate, random(), random());
}

}  // namespace

LeaderElector::LeaderElector(ApiClient* client, Options options, Wakeup* wakeup)
    : client_(client),
      options_(std::move(options)),
      wakeup_(wakeup),
      leases_{"coordination.k8s.io", "v1", "leases", options_.space},
      election_(IdentityOf(options_.candidate), options_.timing),
      thread_([this](const std::stop_token& stop) { Run(stop); }) {}

LeaderElector::~LeaderElector() { Stop(); }

std::optional<int64_t> LeaderElector::Epoch() const {
  const std::lock_guard lock(mutex_);
  return election_.Epoch(BootClock::now());
}

std::string LeaderElector::holder() const {
  const std::lock_guard lock(mutex_);
  return election_.holder();
}

absl::Status LeaderElector::health() const {
  const std::lock_guard lock(mutex_);
  return health_;
}

void LeaderElector::Stop() {
  if (!thread_.joinable()) return;
  {
    const std::lock_guard lock(mutex_);
    election_.Resign();
  }
  thread_.request_stop();
  thread_.join();
  Tell();
  const BootClock::time_point give_up = BootClock::now() + kReleaseTimeout;
  while (true) {
    const BootClock::time_point now = BootClock::now();
    LeaderElection::Step step;
    {
      const std::lock_guard lock(mutex_);
      step = election_.Next(now);
    }
    const auto left = std::chrono::duration_cast<milliseconds>(give_up - now);
    if (step.action == Action::kWait || left.count() <= 0) return;
    Do(step, left, {});
    if (!health().ok()) Pause({}, milliseconds(20));
  }
}

void LeaderElector::Run(const std::stop_token& stop) {
  const milliseconds most = options_.timing.renew_deadline / 2;  // so that a second try fits in
  while (!stop.stop_requested()) {
    const BootClock::time_point now = BootClock::now();
    LeaderElection::Step step;
    milliseconds timeout = most;
    {
      const std::lock_guard lock(mutex_);
      step = election_.Next(now);
      if (election_.Epoch(now)) {  // to tell in time that it is over
        timeout = std::min(timeout, std::chrono::ceil<milliseconds>(election_.until() - now));
      }
    }
    Tell();
    if (step.action == Action::kWait) {
      Pause(stop, std::chrono::ceil<milliseconds>(std::min<BootClock::duration>(step.at - now, std::chrono::hours(1))));
    } else {
      Do(step, timeout, stop);
    }
    Tell();
  }
}

void LeaderElector::Do(const LeaderElection::Step& step, milliseconds timeout, const std::stop_token& stop) {
  CallOptions options{.timeout = timeout, .attempt_timeout = timeout, .attempts = 1, .stop = stop};
  const BootClock::time_point sent = BootClock::now();
  absl::StatusOr<Json> reply;
  if (step.action == Action::kRead) {
    reply = client_->Get(leases_, options_.name, options);
  } else {
    Lease lease = step.lease;
    lease.renewed = MicroTime(absl::Now());
    if (lease.acquired.empty()) lease.acquired = lease.renewed;
    if (step.action == Action::kCreate) {
      object_ = {{"apiVersion", leases_.ApiVersion()},
                 {"kind", "Lease"},
                 {"metadata", {{"name", options_.name}, {"namespace", options_.space}}}};
      PutLease(lease, &object_);
      reply = client_->Create(leases_, object_, options);
    } else {
      PutLease(lease, &object_);
      reply = client_->Replace(leases_, object_, options);
    }
  }

  const std::lock_guard lock(mutex_);
  const BootClock::time_point now = BootClock::now();
  const absl::Status& status = reply.status();
  health_ = absl::OkStatus();
  if (reply.ok()) {
    object_ = *std::move(reply);
    if (step.action == Action::kRead) {
      election_.Read(now, LeaseOf(object_));
    } else {
      election_.Written(sent, now, LeaseOf(object_));
    }
  } else if (step.action == Action::kRead && absl::IsNotFound(status)) {
    election_.Read(now, std::nullopt);
  } else if (absl::IsAborted(status) || absl::IsAlreadyExists(status) ||
             (step.action == Action::kReplace && absl::IsNotFound(status))) {
    election_.Refused(now);
  } else {
    health_ = status;
    election_.Failed(now);
  }
}

void LeaderElector::Tell() {
  const std::optional<int64_t> epoch = Epoch();
  if (epoch != told_) wakeup_->Notify();
  told_ = epoch;
}

}  // namespace aureole::kubernetes
