// Runs one scene in many engines, which trade whole contact components at random in every tick, next to the same scene
// in one engine, and compares all bodies after every tick.
#pragma once

#include <cstdint>
#include <string>

#include "tests/physics/scene.h"

namespace aureole {

struct SplitOptions {
  int engines = 3;
  uint64_t seed = 1;          // of dealing and of the order of creation
  int deal_every = 1;         // ticks
  bool unrelated = true;      // other bodies in the split engines
  bool scratch = true;        // now and then a component is stepped in a Scratch() engine
  bool compare_state = true;  // besides hashes, the saved bytes of one component per tick
};

struct SplitResult {
  std::string difference;  // empty when everything was equal
  int64_t moves = 0;       // bodies that changed their engine
  int64_t touching = 0;    // moves of components of more than one body
  int64_t asleep = 0, body_ticks = 0;
  int64_t wakes = 0;    // bodies that woke
  int64_t largest = 0;  // bodies of the largest component
  uint64_t hash = 0;    // of the whole run of the single engine
};

SplitResult RunSplit(const PhysicsScene& scene, Tick ticks, const SplitOptions& options);

// The hash of the whole run in one engine.
uint64_t RunAlone(const PhysicsScene& scene, Tick ticks);

}  // namespace aureole
