// What a checkpoint costs the tick thread: taking the state of a region full of awake bodies in contact.
#pragma once

#include <cstdint>

namespace aureole {

struct CheckpointCostOptions {
  int bodies = 1000;
  int warm_up = 300;  // ticks until the heap lies
  int checkpoints = 40;
  int every = 15;  // ticks
};

struct CheckpointCostResult {
  double pause_ms = 0, longest_ms = 0;  // thread CPU time of one: median, and the longest
  double tick_ms = 0;                   // of a tick: median
  double kilobytes = 0;
  int64_t contacts = 0;
  uint64_t state_hash = 0;
};

CheckpointCostResult MeasureCheckpointCost(const CheckpointCostOptions& options);

}  // namespace aureole
