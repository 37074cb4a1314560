// `aureole watch`: what is in view of a running world.
#pragma once

#include <string>
#include <vector>

#include <CLI/CLI.hpp>

namespace aureole {

struct WatchCliOptions {
  std::string server;
  std::vector<double> rect, sphere;  // min x, max x, min z, max z; x, z, radius
  double rate = 30;
  double duration_s = 0;  // 0: until interrupted
  bool bodies = false;
  bool json = false;
};

// Adds the command to `app`; `options` outlives it.
CLI::App* AddWatch(CLI::App& app, WatchCliOptions* options);
// Returns an exit code.
int RunWatch(const WatchCliOptions& options);

}  // namespace aureole
