// aureole top: how the region servers of a running world do.
#pragma once

#include <string>

#include <CLI/CLI.hpp>

namespace aureole {

struct TopOptions {
  std::string server;
  double duration_s = 0;  // 0: until interrupted
  bool json = false;
};

CLI::App* AddTop(CLI::App& app, TopOptions* options);
int RunTop(const TopOptions& options);

}  // namespace aureole
