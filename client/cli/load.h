// `aureole load`: many clients of a running world at once, and what they got.
#pragma once

#include <string>

#include <CLI/CLI.hpp>

namespace aureole {

struct LoadOptions {
  std::string server;  // any region server's host:port
  int clients = 100;
  std::string views = "all";  // all | distinct
  double radius = 50;         // m, of distinct views
  double rate = 60;           // frames per second
  double push_rate = 0;       // inputs per second, all clients together
  double duration_s = 10;
  bool json = false;
};

// Adds the command to `app`; `options` outlives it.
CLI::App* AddLoad(CLI::App& app, LoadOptions* options);
// Returns an exit code.
int RunLoad(const LoadOptions& options);

}  // namespace aureole
