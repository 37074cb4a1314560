// `aureole check`: says whether world files are sane, and what their layouts mean.
#pragma once

#include <string>
#include <vector>

#include <CLI/CLI.hpp>

namespace aureole {

struct CheckOptions {
  std::vector<std::string> worlds;
};

// Adds the command to `app`; `options` outlives it.
CLI::App* AddCheck(CLI::App& app, CheckOptions* options);
// Returns an exit code; stops at the first broken file.
int Check(const CheckOptions& options);

}  // namespace aureole
