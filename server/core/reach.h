// How far bodies can get, or make others get, within a few ticks: the `reach` policy (PROTOCOL.md R12), with the energy
// bound for unequal masses.
#pragma once

#include <span>
#include <vector>

#include "server/core/types.h"

namespace aureole {

struct ReachNode {
  BodyId id = 0;
  Box box;              // now
  double mass = 1;      // kg, > 0
  int group = 0;        // index into the energies: bodies that share the energy
  double distance = 0;  // m that the body may have moved; grows
};

struct ReachLimits {
  double speed = 0;     // V_t, m/s
  double recovery = 0;  // m per tick that a solver may move a body, or what it may add to its speed in a tick, in m
  double gravity = 0;   // m/s^2, magnitude
  double dt = 0;        // s
};

// Propagates the bounds by `ticks`: in each tick, bodies that may meet pool their kinetic energy, since a chain of
// strikes can hand all of it to any one of them; a body of mass m then moves at most at sqrt(2 E / m), capped by the
// speed limit. On return `distance` has grown, and `group` and `energies` are what is pooled then. `joined` are pairs
// of indices that always pool (joints). Cost: ticks x (n log n + pairs near each other).
void PropagateReach(std::span<ReachNode> nodes, std::vector<double>* energies,
                    std::span<const std::pair<int, int>> joined, int ticks, const ReachLimits& limits);

}  // namespace aureole
