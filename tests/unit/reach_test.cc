// How far bodies may get: the energy bound of the `reach` policy.
#include "server/core/reach.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

namespace aureole {
namespace {

constexpr double kDt = 0.016;
const ReachLimits kNoGain{32, 0, 0, kDt};

ReachNode At(double x, double mass, int group, int source = 0) {
  ReachNode n;
  n.id = static_cast<BodyId>(group + 1);
  n.box = {{x - 0.5, -0.5, -0.5}, {x + 0.5, 0.5, 0.5}};
  n.mass = mass;
  n.group = group;
  n.source = source;
  return n;
}

Energies Of(std::vector<std::vector<double>> parts) {
  Energies e(static_cast<int>(parts[0].size()));
  for (const auto& row : parts) {
    const int g = e.Add();
    for (size_t s = 0; s < row.size(); ++s) e.At(g, static_cast<int>(s)) = row[s];
  }
  return e;
}

TEST(Reach, ABodyAloneGoesAsFarAsItsSpeed) {
  std::vector<ReachNode> nodes{At(0, 2, 0)};
  Energies e = Of({{0.5 * 2 * 3 * 3}});
  PropagateReach(nodes, &e, {}, 5, kNoGain);
  EXPECT_DOUBLE_EQ(nodes[0].distance, 5 * 3 * kDt);
}

TEST(Reach, ALightBodyThatMayBeStruckByAHeavyOneLeavesFasterThanItCame) {
  std::vector<ReachNode> nodes{At(0, 4, 0), At(1, 1, 1)};
  Energies e = Of({{0.5 * 4 * 5 * 5}, {0}});
  PropagateReach(nodes, &e, {}, 1, kNoGain);
  EXPECT_DOUBLE_EQ(nodes[0].distance, 5 * kDt);
  EXPECT_DOUBLE_EQ(nodes[1].distance, 10 * kDt) << "sqrt(2 E / m)";
  EXPECT_EQ(nodes[0].group, nodes[1].group);
}

TEST(Reach, NothingIsFasterThanTheSpeedLimit) {
  std::vector<ReachNode> nodes{At(0, 1, 0)};
  Energies e = Of({{1e9}});
  PropagateReach(nodes, &e, {}, 1, kNoGain);
  EXPECT_DOUBLE_EQ(nodes[0].distance, 32 * kDt);
}

TEST(Reach, WhatSleepsAloneStays) {
  std::vector<ReachNode> nodes{At(0, 1, 0)};
  Energies e = Of({{0}});
  PropagateReach(nodes, &e, {}, 9, {32, 0.02, 10, kDt});
  EXPECT_EQ(nodes[0].distance, 0);
}

TEST(Reach, GravityAddsInEveryTickAndAPushOnce) {
  std::vector<ReachNode> nodes{At(0, 1, 0)};
  nodes[0].push = 1;
  Energies e = Of({{0.5}});  // 1 m/s
  PropagateReach(nodes, &e, {}, 1, {32, 0, 10, kDt});
  const double first = 1 + 1 + 10 * kDt;
  EXPECT_NEAR(nodes[0].distance, first * kDt, 1e-12);
  PropagateReach(nodes, &e, {}, 1, {32, 0, 10, kDt});
  EXPECT_NEAR(nodes[0].distance, (2 * first + 10 * kDt) * kDt, 1e-12);
}

TEST(Reach, EnergiesPoolByWhoToldOfThem) {
  std::vector<ReachNode> nodes{At(0, 1, 0, 0), At(1, 1, 1, 1), At(2, 1, 2, 2), At(50, 1, 3, 1)};
  Energies e = Of({{1, 0, 0}, {0, 2, 0}, {0, 0, 4}, {0, 8, 0}});
  PropagateReach(nodes, &e, {}, 1, kNoGain);
  const int g = nodes[0].group;
  EXPECT_EQ(nodes[2].group, g);
  EXPECT_EQ(e.At(g, 0), 1);
  EXPECT_EQ(e.At(g, 1), 2);
  EXPECT_EQ(e.At(g, 2), 4);
  EXPECT_EQ(e.Sum(g), 7);
  EXPECT_NE(nodes[3].group, g);
  EXPECT_EQ(e.Sum(nodes[3].group), 8);
}

TEST(Reach, JointedBodiesPoolHoweverFarApart) {
  std::vector<ReachNode> nodes{At(0, 1, 0), At(9, 1, 1)};
  Energies e = Of({{2}, {0}});
  const std::vector<std::pair<int, int>> joined{{0, 1}};
  PropagateReach(nodes, &e, joined, 1, kNoGain);
  EXPECT_DOUBLE_EQ(nodes[1].distance, 2 * kDt);
}

}  // namespace
}  // namespace aureole
