#include "tests/bench/checkpoint_cost.h"

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "server/core/region.h"
#include "server/physics/bullet_engine.h"
#include "tests/bench/heap_world.h"
#include "tests/bench/quantile.h"
#include "tests/bench/thread_time.h"

namespace aureole {

CheckpointCostResult MeasureCheckpointCost(const CheckpointCostOptions& options) {
  const World world = HeapWorld(options.bodies);
  Region region(world, 0, MakeBulletEngine(world.environment));
  std::vector<Frame> frames;
  const auto advance = [&](Tick to) {
    while (region.tick() < to) {
      frames.clear();
      region.Advance(&frames);
    }
  };
  advance(options.warm_up);
  CheckpointCostResult result;
  std::vector<double> pauses, ticks;
  std::string spare;
  for (int i = 0; i < options.checkpoints; ++i) {
    double begin = ThreadSeconds();
    advance(region.tick() + options.every);
    ticks.push_back((ThreadSeconds() - begin) * 1e3 / options.every);
    begin = ThreadSeconds();
    std::string state = std::move(spare);
    state.clear();
    region.SaveTo(&state);
    pauses.push_back((ThreadSeconds() - begin) * 1e3);
    result.kilobytes = static_cast<double>(state.size()) / 1e3;
    spare = std::move(state);
  }
  result.longest_ms = *std::max_element(pauses.begin(), pauses.end());
  result.pause_ms = Median(std::move(pauses));
  result.tick_ms = Median(std::move(ticks));
  result.contacts = region.engine().Counts().contacts;
  result.state_hash = region.StateHash();
  return result;
}

}  // namespace aureole
