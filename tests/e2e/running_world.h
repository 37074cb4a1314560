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

// Weightless, three regions; bodies fly to and fro over the borders in lanes of their own.
inline v1::WorldSpec Lanes(int bodies) {
  v1::WorldSpec spec;
  spec.set_name("lanes");
  spec.mutable_gravity();
  for (double edge : {-5, 5}) spec.mutable_layout()->mutable_columns()->add_edges(edge);
  spec.mutable_client_limits()->set_rate(1e6);
  for (int i = 0; i < bodies; ++i) {
    v1::Body* b = spec.add_bodies();
    b->set_id(static_cast<uint64_t>(i + 1));
    b->mutable_shape()->mutable_sphere()->set_radius(0.3);
    b->set_mass(1);
    b->mutable_position()->set_x(i % 2 == 0 ? -12 : 12);
    b->mutable_position()->set_z(3 * i);
    b->mutable_velocity()->set_x(i % 2 == 0 ? 4 : -4);
  }
  return spec;
}

}  // namespace aureole
