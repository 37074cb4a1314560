// `aureole experiment`: the paper's section 5 with real processes, each run compared with the undivided world.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "aureole/v1/world.pb.h"

namespace aureole {

struct ExperimentOptions {
  std::vector<std::string> worlds;
  bool policies = false;  // the table of policies.h instead of worlds
  std::optional<uint64_t> seed;
  double duration_s = 0;  // 0: as the command's help says
  int repeat = 1;
  bool no_real_time = false;
  bool json = false;
  std::string out = "experiment";
  std::string region_server;
};

// Adds the command to `app`; `options` outlives it.
CLI::App* AddExperiment(CLI::App& app, ExperimentOptions* options);
// Returns an exit code. Signals must be caught already (CatchInterrupts).
int RunExperiment(const ExperimentOptions& options);

// Equal for worlds whose undivided runs are the same: that differ at most in name, description, layout and exchange.
std::string ContentKey(const v1::WorldSpec& spec);

}  // namespace aureole
