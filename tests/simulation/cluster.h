// The cluster simulation: many regions in one thread, joined by a seeded network, checked against the undivided world
// after every tick (DESIGN.md section 5). The undivided reference is the engine without any aura code.
#pragma once

#include <cstdint>
#include <string>

#include "tests/simulation/scenario.h"

namespace aureole::sim {

// What the network may do. Nothing of it may change a bit.
struct Faults {
  bool delay = true;  // up to 20 ms a frame, per link
  bool jitter = true;
  bool duplicates = true;
  bool reconnects = true;  // a connection is cut: what is under way is lost, the next one resumes
  bool stalls = true;      // a region stops for up to 100 ms
  // One region, or two, lose all that they have in memory, between any two phases, and go on from their last
  // checkpoint.
  bool crashes = false;
  // k = 0: now and then the layout changes: borders move, a region joins, or one loses its area and, when the last body
  // has gone, leaves.
  bool layouts = false;

  static Faults None() { return {false, false, false, false, false, false, false}; }
};

struct Verdict {
  bool ok = true;
  Tick tick = 0;          // first bad tick
  std::string invariant;  // "I1".. "I6", "inputs", "layout", ..
  std::string message;

  // What the seed went through.
  int64_t transfers = 0, touching_transfers = 0, bodies_moved = 0, returns = 0;
  int64_t wakes = 0;
  int64_t largest_cluster = 0, longest_chain = 0;
  int64_t graphs_again = 0;  // ticks in which a box was told late (k = 0)
  int64_t spawns = 0, live_inputs = 0;
  int64_t reconnects = 0, duplicates = 0, stalls = 0;
  int64_t crashes = 0, replayed_ticks = 0, together = 0;  // together: died while another was dead
  int64_t layouts = 0, joined = 0, left = 0, refused_layouts = 0;
  int64_t violations = 0;
  int64_t home_crossings = 0, away_body_ticks = 0, body_ticks = 0;
  uint64_t hash = 0;  // of the last state
};

Verdict RunCluster(const Scenario& scenario, uint64_t seed, const Faults& faults, const EngineFactory& make_engine);

}  // namespace aureole::sim
