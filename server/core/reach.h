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
  int group = 0;        // row of the energies: bodies that share the energy
  int source = 0;       // column of the energies: who told of the body
  double distance = 0;  // m that the body may have moved; grows
  double push = 0;      // m/s that the solver may yet add to its speed, to push it out of others; used up
};

struct ReachLimits {
  double speed = 0;     // V_t, m/s
  double recovery = 0;  // m per tick that a solver may move a body beyond its speed, to push it out of others
  double gravity = 0;   // m/s^2, magnitude
  double dt = 0;        // s
};

// J, per group and source: what the bodies of a group may have together, by who told of it. A region tells another what
// it has from all but that other, which would count its own energy again in every exchange.
class Energies {
 public:
  explicit Energies(int sources) : sources_(sources) {}
  int groups() const { return static_cast<int>(joules_.size()) / sources_; }
  int sources() const { return sources_; }
  // A new group without energy.
  int Add() {
    joules_.resize(joules_.size() + static_cast<size_t>(sources_), 0.0);
    return groups() - 1;
  }
  double& At(int group, int source) { return joules_[Index(group, source)]; }
  double At(int group, int source) const { return joules_[Index(group, source)]; }
  std::span<const double> Of(int group) const { return {&joules_[Index(group, 0)], static_cast<size_t>(sources_)}; }
  double Sum(int group) const;

 private:
  size_t Index(int group, int source) const { return static_cast<size_t>(group * sources_ + source); }
  int sources_;
  std::vector<double> joules_;
};

// Propagates the bounds by `ticks`: in each tick, bodies that may meet pool their kinetic energy, since a chain of
// strikes can hand all of it to any one of them; a body of mass m then moves at most at sqrt(2 E / m), capped by the
// speed limit. On return `distance` has grown, and `group` and `energies` are what is pooled then. `joined` are pairs
// of indices that always pool (joints). Cost: ticks x (n log n + pairs near each other + groups x sources).
void PropagateReach(std::span<ReachNode> nodes, Energies* energies, std::span<const std::pair<int, int>> joined,
                    int ticks, const ReachLimits& limits);

}  // namespace aureole
