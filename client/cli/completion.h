// aureole completion: scripts that complete the commands and options of `aureole` in a shell.
#pragma once

#include <string>

#include <CLI/CLI.hpp>

namespace aureole {

struct CompletionOptions {
  std::string shell;  // bash, zsh or fish
};

CLI::App* AddCompletion(CLI::App& app, CompletionOptions* options);
// `app`: whose commands and options are completed.
int RunCompletion(const CLI::App& app, const CompletionOptions& options);

}  // namespace aureole
