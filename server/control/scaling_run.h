// Scales a run by its load: what the autoscaler is shown of it, and what becomes of its decisions.
#pragma once

#include <chrono>
#include <functional>
#include <string>
#include <vector>

#include "server/control/autoscaler.h"
#include "server/control/layout_desk.h"
#include "server/control/run_status.h"

namespace aureole {

// The load of a run, as it was seen at that time.
LoadSeen SeeLoad(const RunStatus& status, const LayoutDesk::State& layout, std::chrono::steady_clock::time_point now);

// By region, for LayoutDesk::ResizeTo: bodies, those awake above all.
std::vector<double> WeightsOf(const RunStatus& status);

// Of a run that scales itself. One thread at a time.
class ScalingRun {
 public:
  // `desk` outlives it. `tell`: what was decided and why, for people. Preconditions: of Autoscaler.
  ScalingRun(const ScalingOptions& options, LayoutDesk* desk, std::function<void(const std::string&)> tell);

  // At each look.
  void Step(const RunStatus& status);

 private:
  LayoutDesk* const desk_;
  const std::function<void(const std::string&)> tell_;
  Autoscaler autoscaler_;
};

}  // namespace aureole
