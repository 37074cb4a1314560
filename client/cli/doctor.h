// aureole doctor: whether this machine can run worlds, and whether a running world is well.
#pragma once

#include <string>

#include <CLI/CLI.hpp>

namespace aureole {

struct DoctorOptions {
  std::string server;  // empty: only this machine
  bool json = false;
};

CLI::App* AddDoctor(CLI::App& app, DoctorOptions* options);
int RunDoctor(const DoctorOptions& options);

}  // namespace aureole
