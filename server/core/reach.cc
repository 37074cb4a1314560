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

double Energies::Sum(int group) const {
  double sum = 0;
  for (double part : Of(group)) sum += part;
  return sum;
}

void PropagateReach(std::span<ReachNode> nodes, Energies* energies, std::span<const std::pair<int, int>> joined,
                    int ticks, const ReachLimits& limits) {
  std::vector<int> order;
  for (int tick = 0; tick < ticks; ++tick) {
    UnionFind groups(energies->groups());
    PoolNear(nodes, &order, &groups);
    for (auto [a, b] : joined) groups.Unite(nodes[a].group, nodes[b].group);
    Energies pooled(energies->sources());
    for (int g = 0; g < groups.size(); ++g) pooled.Add();
    for (int g = 0; g < groups.size(); ++g) {
      for (int s = 0; s < energies->sources(); ++s) pooled.At(groups.Find(g), s) += energies->At(g, s);
    }
    std::vector<double> sums;
    for (int g = 0; g < groups.size(); ++g) sums.push_back(pooled.Sum(g));
    for (ReachNode& n : nodes) {
      n.group = groups.Find(n.group);
      const double energy = sums[n.group];
      if (energy <= 0) continue;  // what sleeps alone stays: nothing gains speed in a group without energy
      const double speed = std::sqrt(2 * energy / n.mass);
      const double next = std::min(limits.speed, speed + limits.gravity * limits.dt + n.push);
      n.push = 0;
      // E grows by the work on this body: m v dv + m dv^2 / 2.
      const double dv = std::max(0.0, next - speed);
      double& part = pooled.At(n.group, n.source);
      part = std::min(part + n.mass * dv * (speed + dv / 2), kMostEnergy);
      n.distance += next * limits.dt + limits.recovery;
    }
    *energies = std::move(pooled);
  }
}

}  // namespace aureole
