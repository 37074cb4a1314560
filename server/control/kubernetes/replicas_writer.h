// Writes spec.replicas of a World that does not say how many regions it has, once it runs: a budget
// (PodDisruptionBudget) finds the number of Pods to expect there, and without it lets none be evicted.
#pragma once

#include <chrono>
#include <cstdint>
#include <string>

#include <absl/status/status.h>

#include "server/control/kubernetes/api_client.h"

namespace aureole::kubernetes {

// One thread.
class ReplicasWriter {
 public:
  // `client` must outlive it.
  ReplicasWriter(ApiClient* client, std::string space, std::string name, std::chrono::milliseconds again);

  // Call it often, with the World as it is now. Nothing when it has the number, or was given it; else waits for the API
  // server, 2 s at most. What that says is returned, and it is asked again after `again`.
  absl::Status Look(const Json& world, int replicas);

 private:
  using Clock = std::chrono::steady_clock;

  ApiClient* const client_;
  const std::string space_, name_;
  const std::chrono::milliseconds again_;
  int64_t written_ = -1;  // the generation that had none; the next one has it
  Clock::time_point next_try_;
};

}  // namespace aureole::kubernetes
