// A world on real region servers, for the time that a test plays with it.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "server/control/local_allocator.h"
#include "server/control/run.h"

namespace aureole {

// Calls `play` once all servers have stepped a few ticks; then ends them.
inline void PlayRun(const v1::WorldSpec& world, int regions, const std::function<void(const RunStatus&)>& play) {
  RunOptions options;
  options.world = world;
  options.regions = regions;
  LocalAllocator allocator({});
  RunResult result;
  bool played = false;
  const absl::Status end = RunWorld(
      options, allocator,
      [&](const RunStatus& status) {
        if (status.stage != Stage::kRunning || status.MinTick() < 5) return true;
        play(status);
        played = true;
        return false;
      },
      &result);
  EXPECT_EQ(end.code(), absl::StatusCode::kCancelled) << end;
  EXPECT_TRUE(played);
}

// The same, with the servers' endpoints, in order.
inline void PlayIn(const v1::WorldSpec& world, int regions,
                   const std::function<void(const std::vector<std::string>& endpoints)>& play) {
  PlayRun(world, regions, [&](const RunStatus& status) {
    std::vector<std::string> endpoints;
    for (const RegionStatus& r : status.regions) endpoints.push_back(r.endpoint);
    play(endpoints);
  });
}

}  // namespace aureole
