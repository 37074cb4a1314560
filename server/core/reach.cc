#include "server/core/reach.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "server/core/union_find.h"

namespace aureole {
namespace {

// J. More than any body of limits.h has at any speed of limits.h: a larger bound says nothing new, and would overflow
// the float32 of an aura.
constexpr double kMostEnergy = 1e24;

// Unites the groups of all pairs whose boxes, grown by what they may have moved, meet.
void PoolNear(std::span<const ReachNode> nodes, std::vector<int>* order, UnionFind* groups) {
  order->resize(nodes.size());
  std::iota(order->begin(), order->end(), 0);
  auto low = [&](int i) { return nodes[i].box.min.x() - nodes[i].distance; };
  std::sort(order->begin(), order->end(), [&](int a, int b) { return low(a) != low(b) ? low(a) < low(b) : a < b; });
  for (size_t i = 0; i < order->size(); ++i) {
    const ReachNode& a = nodes[(*order)[i]];
    const double high = a.box.max.x() + a.distance;
    for (size_t j = i + 1; j < order->size() && low((*order)[j]) <= high; ++j) {
      const ReachNode& b = nodes[(*order)[j]];
      if (Gap(a.box, b.box) <= a.distance + b.distance) groups->Unite(a.group, b.group);
    }
  }
}

}  // namespace

void PropagateReach(std::span<ReachNode> nodes, std::vector<double>* energies,
                    std::span<const std::pair<int, int>> joined, int ticks, const ReachLimits& limits) {
  // A body at rest in the field, or pushed out by the solver, gains this much speed in a tick.
  const double gain = limits.gravity * limits.dt + limits.recovery / limits.dt;
  std::vector<int> order;
  for (int tick = 0; tick < ticks; ++tick) {
    UnionFind groups(static_cast<int>(energies->size()));
    PoolNear(nodes, &order, &groups);
    for (auto [a, b] : joined) groups.Unite(nodes[a].group, nodes[b].group);
    std::vector<double> pooled(energies->size(), 0.0);
    for (int g = 0; g < groups.size(); ++g) pooled[groups.Find(g)] += (*energies)[g];
    // What sleeps alone stays: nothing gains speed in a group without energy.
    std::vector<double> gained(energies->size(), 0.0);
    for (ReachNode& n : nodes) {
      n.group = groups.Find(n.group);
      if (pooled[n.group] <= 0) continue;
      const double speed = std::sqrt(2 * pooled[n.group] / n.mass);
      const double next = std::min(limits.speed, speed + gain);
      // E grows by the work on this body: m v dv + m dv^2 / 2.
      const double dv = std::max(0.0, next - speed);
      gained[n.group] += n.mass * dv * (speed + dv / 2);
      n.distance += next * limits.dt + limits.recovery;
    }
    for (size_t g = 0; g < pooled.size(); ++g) (*energies)[g] = std::min(pooled[g] + gained[g], kMostEnergy);
  }
}

}  // namespace aureole
