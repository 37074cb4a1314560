// aureole token: who may call a world.
#pragma once

#include <string>
#include <vector>

#include <CLI/CLI.hpp>

namespace aureole {

struct TokenOptions {
  std::string name, world, tokens;
  std::vector<std::string> rights;
  int days = 0;  // 0: for ever
};

CLI::App* AddToken(CLI::App& app, TokenOptions* options);
int RunToken(const TokenOptions& options);

}  // namespace aureole
