// aureole replay: a recording, simulated again in one piece.
#pragma once

#include <string>

#include <CLI/CLI.hpp>

namespace aureole {

struct ReplayOptions {
  std::string file;
  bool verify = false;
  bool json = false;
};

CLI::App* AddReplay(CLI::App& app, ReplayOptions* options);
int RunReplay(const ReplayOptions& options);

}  // namespace aureole
