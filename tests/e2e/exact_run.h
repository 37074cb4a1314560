// Runs of shipped worlds, and whether they came out as the undivided world, bit for bit.
#pragma once

#include <gtest/gtest.h>

#include <map>
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

// The same of a run without an end, whose regions may change: every hash from this tick to the one that all have
// reached, whose sum is left in `last`.
inline void ExpectExactSoFar(const RunResult& result, RunOptions options, Tick from = 0, TickSum* last = nullptr) {
  options.layouts = nullptr;
  options.scaling = {};
  options.store = nullptr;
  options.leave = nullptr;
  options.undivided = options.no_real_time = true;
  options.regions = 1;
  options.checkpoint_every = 0;
  options.last_tick = result.status.MinTick() / options.hash_every * options.hash_every;
  LocalAllocator allocator({});
  RunResult whole;
  const absl::Status s = RunWorld(
      options, allocator, [](const RunStatus&) { return true; }, &whole);
  ASSERT_TRUE(s.ok()) << s;
  std::map<Tick, TickSum> found;
  for (const TickSum& sum : result.hashes) found[sum.tick] = sum;
  ASSERT_GT(whole.hashes.size(), 10u);
  for (const TickSum& expected : whole.hashes) {
    if (expected.tick < from) continue;
    ASSERT_EQ(found[expected.tick].bodies, expected.bodies) << "tick " << expected.tick;
    ASSERT_EQ(found[expected.tick].hash, expected.hash) << "tick " << expected.tick;
  }
  EXPECT_TRUE(result.violations.empty());
  if (last != nullptr) *last = whole.hashes.back();
}

}  // namespace aureole
