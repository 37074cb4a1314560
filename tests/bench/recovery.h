// Region servers that are killed at random moments while a world runs in real time: what it costs, and whether the
// world ends as if nothing had happened.
#pragma once

#include <string>

namespace aureole {

struct RecoveryOptions {
  std::string world = "tests/worlds/demo.json";
  int kills = 200;
  int every_ms = 400;  // wall time between kills, on average; one time in four two servers at once
  uint32_t seed = 1;
  double checkpoint_s = 1;
};

struct RecoveryResult {
  bool ok = false;
  std::string message;  // why not
  int killed = 0;
  int64_t ticks = 0, bodies = 0;
  int hashes = 0, equal = 0;  // of the whole world; of these, those that equal the undivided world's
  double longest_stop_s = 0;  // in which the world did not tick
  double lost_s = 0;          // by which the world fell behind the wall clock, in all
  int64_t checkpoints = 0;
  double checkpoint_kb = 0, write_ms = 0, pause_ms = 0;  // of the last ones: the largest; the longest pause of a tick
};

// Prints nothing; takes about kills x every_ms, and the undivided run.
RecoveryResult MeasureRecovery(const RecoveryOptions& options);

}  // namespace aureole
