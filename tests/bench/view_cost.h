// What a view of a small part of a large world costs the region server, beside the same view in a world that is no
// larger than the view: CPU of the tick thread's capture and of the publisher, per frame.
#pragma once

#include <cstdint>

namespace aureole {

struct ViewCostOptions {
  int bodies = 100'000;  // all awake; 1,024 are in view
  int frames = 60;
};

struct ViewCostResult {
  double large_us = 0, small_us = 0;            // CPU per frame, medians
  double large_tick_us = 0, small_tick_us = 0;  // of it, that of the tick thread
  double ratio = 0;                             // of these
  int in_view = 0;
  // What one more view of its own costs per frame in the large world.
  double distinct_us = 0;
};

ViewCostResult MeasureViewCost(const ViewCostOptions& options);

}  // namespace aureole
