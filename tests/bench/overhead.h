// What exactness costs: one region with all the machinery against stock Bullet float64 on the same scene.
#pragma once

#include <cstdint>
#include <string>

namespace aureole {

struct OverheadOptions {
  int bodies = 700;
  int warm_up = 300;  // ticks until the heap lies
  int blocks = 24;    // of each world, interleaved
  int block = 25;     // ticks
};

struct OverheadResult {
  double region_ms = 0, stock_ms = 0;    // thread CPU time of a tick, median of the blocks' means
  double ratio_median = 0;               // of the ratios of neighbouring blocks
  double ratio_low = 0, ratio_high = 0;  // quartiles
  int64_t region_contacts = 0, stock_contacts = 0;
  uint64_t state_hash = 0;  // of the region
};

OverheadResult MeasureOverhead(const OverheadOptions& options);

}  // namespace aureole
