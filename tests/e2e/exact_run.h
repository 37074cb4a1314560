// Runs of shipped worlds, and whether they came out as the undivided world, bit for bit.
#pragma once

#include <gtest/gtest.h>

#include <string>

#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/world_file.h"

namespace aureole {

// Of a world of tests/worlds.
inline RunOptions OptionsFor(const std::string& world, Tick last_tick, Tick hash_every, Tick checkpoint_every = 0) {
  const absl::StatusOr<WorldFile> file = OpenWorldFile(std::string(AUREOLE_WORLDS "/") + world);
  EXPECT_TRUE(file.ok()) << file.status();
  RunOptions options;
  options.world = file->spec;
  options.regions = file->world.layout.size();
  options.last_tick = last_tick;
  options.hash_every = hash_every;
  options.checkpoint_every = checkpoint_every;
  return options;
}

// Every hash is there, told by all regions, and is that of the undivided world.
inline void ExpectExact(const RunResult& result, RunOptions options) {
  options.undivided = options.no_real_time = true;
  options.regions = 1;
  options.checkpoint_every = 0;
  LocalAllocator allocator({});
  RunResult whole;
  const absl::Status s = RunWorld(
      options, allocator, [](const RunStatus&) { return true; }, &whole);
  ASSERT_TRUE(s.ok()) << s;
  ASSERT_EQ(result.hashes.size(), whole.hashes.size());
  for (size_t i = 0; i < whole.hashes.size(); ++i) {
    EXPECT_EQ(result.hashes[i].tick, whole.hashes[i].tick);
    EXPECT_EQ(result.hashes[i].regions, static_cast<int>(result.status.regions.size()));
    EXPECT_EQ(result.hashes[i].hash, whole.hashes[i].hash) << "tick " << whole.hashes[i].tick;
    EXPECT_EQ(result.hashes[i].bodies, whole.hashes[i].bodies) << "tick " << whole.hashes[i].tick;
  }
}

}  // namespace aureole
