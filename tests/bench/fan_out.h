// What many clients that share one view cost a region server: its CPU, and its tick thread, with and without them in
// turns. Starts real processes: a server, and `aureole load`.
#pragma once

#include <string>

namespace aureole {

struct FanOutOptions {
  int clients = 200;
  int bodies = 1000;
  int blocks = 6;       // of 10 s, with clients and without in turns, of each kind
  std::string aureole;  // the program; beside this one when empty
};

struct FanOutResult {
  bool ok = false;
  double cores = 0;           // of the server's CPU, taken by the clients: median of neighbouring blocks' differences
  double tick_p99_ratio = 0;  // of the tick thread's p99 with clients to that without, likewise
  double tick_p99_ms = 0;     // without clients, median
  double base_cores = 0;      // without clients, median
};

FanOutResult MeasureFanOut(const FanOutOptions& options);

}  // namespace aureole
