// What operators do to a running world, and see of it: `aureole world`, `aureole events`, `aureole resize`,
// `aureole drain` and `aureole checkpoint`.
#pragma once

#include <cstdint>
#include <string>

#include <CLI/CLI.hpp>

namespace aureole {

struct OperateOptions {
  std::string control, world;
  int columns = 1, rows = 1;
  int region = 0;
  double wait_s = 60;
  uint64_t after = 0;
  bool follow = false;
  bool copied = false;
  bool json = false;
};

CLI::App* AddWorld(CLI::App& app, OperateOptions* o);
CLI::App* AddEvents(CLI::App& app, OperateOptions* o);
CLI::App* AddResize(CLI::App& app, OperateOptions* o);
CLI::App* AddDrain(CLI::App& app, OperateOptions* o);
CLI::App* AddCheckpoint(CLI::App& app, OperateOptions* o);

// Each returns an exit code.
int RunWorldCommand(const OperateOptions& o);
int RunEvents(const OperateOptions& o);
int RunResize(const OperateOptions& o);
int RunDrain(const OperateOptions& o);
int RunCheckpoint(const OperateOptions& o);

}  // namespace aureole
