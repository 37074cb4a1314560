// Flags that several commands have.
#pragma once

#include <string>

#include <CLI/CLI.hpp>

namespace aureole {

// Adds --duration, which takes times such as 60s, 2m or 500ms (> 0, at most a year), as seconds.
CLI::Option* AddDuration(CLI::App* command, double* seconds, const std::string& help);

}  // namespace aureole
