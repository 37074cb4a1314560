// aureole record: a running world into a file that can be simulated again, drawn and reported.
#pragma once

#include <string>

#include <CLI/CLI.hpp>

namespace aureole {

struct RecordOptions {
  std::string server;
  std::string out;
  double duration_s = 0;  // 0: until interrupted
  int64_t hash_every = 16;
  double rate = 20;  // frames/s; 0: none
  bool json = false;
};

CLI::App* AddRecord(CLI::App& app, RecordOptions* options);
int RunRecord(const RecordOptions& options);

}  // namespace aureole
