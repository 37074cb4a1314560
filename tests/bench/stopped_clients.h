// What the clients that read on notice when others of the same view stop reading (SIGSTOP), and what the server's
// memory does. Starts real processes.
#pragma once

#include <string>

namespace aureole {

struct StoppedClientsOptions {
  int clients = 200;
  int stopped = 50;
  int bodies = 1000;
  std::string aureole;  // the program; beside this one when empty
};

struct StoppedClientsResult {
  bool ok = false;
  // Of the clients that read on, over 12 s each: while all read, and while the others are stopped.
  double rate_before = 0, rate_after = 0;            // frames/s of the slowest
  double p99_before_ms = 0, p99_after_ms = 0;        // between two frames
  double memory_before_mb = 0, memory_after_mb = 0;  // of the server, resident; the largest while they are stopped
};

StoppedClientsResult MeasureStoppedClients(const StoppedClientsOptions& options);

}  // namespace aureole
