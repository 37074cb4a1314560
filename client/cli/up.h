// `aureole up`: runs a world on region servers of its own and shows it.
#pragma once

#include <string>

#include <CLI/CLI.hpp>

#include "server/control/autoscaler.h"

namespace aureole {

struct UpOptions {
  std::string world;
  double duration_s = 0;  // of simulated time; 0: until interrupted
  bool no_real_time = false;
  bool json = false;
  bool undivided = false;
  bool verbose = false;
  int64_t hash_every = -1;              // ticks; -1: 100 when there is a duration, else none
  std::string control = "127.0.0.1:0";  // where servers and operators reach the control plane
  std::string logs, data, region_server;
  double checkpoint_s = 1;  // 0: none
  ScalingOptions scaling;
  std::string tls, tokens;  // as aureole-region --help has them; empty: none
  std::string viewer;       // directory of the browser viewer; empty: none
};

// Adds the command to `app`; `options` outlives it.
CLI::App* AddUp(CLI::App& app, UpOptions* options);
// Returns an exit code. Signals must be caught already (CatchInterrupts).
int Up(const UpOptions& options);

}  // namespace aureole
