// Scales a World by its load: writes spec.replicas as a person would, so that whoever reads it, and counts by it, sees
// what is meant.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>

#include <absl/status/status.h>

#include "server/control/autoscaler.h"
#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/world_resource.h"
#include "server/control/layout_desk.h"
#include "server/control/run_status.h"

namespace aureole::kubernetes {

// One thread at a time.
class WorldScaler {
 public:
  // What happens, for the World's events.
  using Tell = std::function<void(bool warning, const std::string& reason, const std::string& message)>;

  // The pointers outlive it. `leads`: whether this control plane may still write.
  WorldScaler(ApiClient* client, LayoutDesk* desk, std::function<bool()> leads, Tell tell);

  // At each look. Blocks for a request, two seconds at most, where the number of regions is to be another one; what
  // could not be written is tried again, unless something else is wanted meanwhile.
  void Look(const WorldResource& world, const RunStatus& status);

 private:
  using Clock = std::chrono::steady_clock;

  void Write(const WorldResource& world, const RunStatus& status);

  ApiClient* const client_;
  LayoutDesk* const desk_;
  const std::function<bool()> leads_;
  const Tell tell_;
  std::optional<Autoscaler> autoscaler_;
  std::optional<Scaling> wanted_;  // and not written yet
  int64_t corrected_ = -1;         // the generation whose replicas were
  Clock::time_point next_try_;
  absl::Status told_;
};

}  // namespace aureole::kubernetes
