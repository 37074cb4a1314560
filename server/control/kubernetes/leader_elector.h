// Leads, or waits to lead: leader_election.h on a thread of its own, with the API server and the clock.
#pragma once

#include <cstdint>
#include <mutex>
#include <optional>
#include <string>
#include <thread>

#include <absl/status/status.h>

#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/leader_election.h"
#include "server/control/kubernetes/wakeup.h"

namespace aureole::kubernetes {

class LeaderElector {
 public:
  struct Options {
    std::string space, name;  // of the lease. Nobody may delete it: the epochs would begin again
    std::string candidate;    // the pod's name, say; the identity is made of it and something random
    ElectionTiming timing = {};
  };

  // Starts. `client` and `wakeup`, which is notified when leading begins or ends, must outlive it.
  LeaderElector(ApiClient* client, Options options, Wakeup* wakeup);
  // Stops.
  ~LeaderElector();
  LeaderElector(const LeaderElector&) = delete;
  LeaderElector& operator=(const LeaderElector&) = delete;

  // Any thread; reads the clock. The epoch when we lead now: ask right before each act, and send it along with it.
  std::optional<int64_t> Epoch() const;
  // As last seen; empty: nobody.
  std::string holder() const;
  const std::string& identity() const { return election_.identity(); }
  // Why the lease could not be read or written the last time.
  absl::Status health() const;

  // Ends leading at once, then releases the lease, so that the next one need not wait: tries for at most
  // kReleaseTimeout. Idempotent.
  void Stop();
  static constexpr std::chrono::milliseconds kReleaseTimeout{1000};

 private:
  void Run(const std::stop_token& stop);
  // The request of a step, and what came of it.
  void Do(const LeaderElection::Step& step, std::chrono::milliseconds timeout, const std::stop_token& stop);
  void Tell();

  ApiClient* const client_;
  const Options options_;
  Wakeup* const wakeup_;
  const Resource leases_;
  Json object_;                  // the lease as last read or written; of one thread at a time
  std::optional<int64_t> told_;  // likewise: the epoch at the last notification

  mutable std::mutex mutex_;
  LeaderElection election_;
  absl::Status health_;
  std::jthread thread_;
};

}  // namespace aureole::kubernetes
