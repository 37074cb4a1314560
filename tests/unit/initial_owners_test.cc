#include <algorithm>
#include <cstdint>
#include <vector>

#include <gtest/gtest.h>

#include "server/core/world.h"

namespace aureole {
namespace {

World TwoColumns() {
  const double edges[] = {0};
  return World(*Layout::Columns(edges));
}

// A cube of edge 1 about a point.
BodyView Cube(BodyId id, double x, double y = 0, double z = 0, double mass = 1) {
  BodyView view;
  view.id = id;
  view.centre = {x, y, z};
  view.box = {view.centre.array() - 0.5, view.centre.array() + 0.5};
  view.mass = mass;
  return view;
}

JointSpec Join(JointId id, BodyId a, BodyId b) {
  JointSpec joint;
  joint.id = id;
  joint.a = a;
  joint.b = b;
  return joint;
}

using Owners = std::vector<RegionId>;

TEST(InitialOwners, ALoneBodyBelongsToItsHome) {
  EXPECT_EQ(InitialOwners(TwoColumns(), {Cube(1, -3), Cube(2, 3), Cube(3, 0)}, 0), (Owners{0, 1, 1}))
      << "a point on an edge belongs to the greater side";
}

TEST(InitialOwners, AComponentGoesWholeToTheHomeOfMostOfItsMass) {
  EXPECT_EQ(InitialOwners(TwoColumns(), {Cube(1, -1.4), Cube(2, -0.5), Cube(3, 0.4)}, 0), (Owners{0, 0, 0}));
  EXPECT_EQ(InitialOwners(TwoColumns(), {Cube(1, -1.4), Cube(2, -0.5), Cube(3, 0.4, 0, 0, 2.5)}, 0), (Owners{1, 1, 1}))
      << "mass, not number";
}

TEST(InitialOwners, ATieGoesToTheBetterRank) {
  World world = TwoColumns();
  EXPECT_EQ(InitialOwners(world, {Cube(1, -0.4), Cube(2, 0.4)}, 0), (Owners{0, 0}));
  ASSERT_TRUE(world.layout.SetRanks({1, 0}).ok());
  EXPECT_EQ(InitialOwners(world, {Cube(1, -0.4), Cube(2, 0.4)}, 0), (Owners{1, 1}));
}

TEST(InitialOwners, BoxesThatTouchInAPointAreOneComponent) {
  EXPECT_EQ(InitialOwners(TwoColumns(), {Cube(1, -0.5), Cube(2, 0.5, 1, 1, 2)}, 0), (Owners{1, 1}));
  EXPECT_EQ(InitialOwners(TwoColumns(), {Cube(1, -0.5), Cube(2, 0.5, 1.001, 1, 2)}, 0), (Owners{0, 1}));
}

TEST(InitialOwners, TheMarginJoinsWhatIsNear) {
  const std::vector<BodyView> views = {Cube(1, -1), Cube(2, 0.5, 0, 0, 2)};
  EXPECT_EQ(InitialOwners(TwoColumns(), views, 0.49), (Owners{0, 1}));
  EXPECT_EQ(InitialOwners(TwoColumns(), views, 0.5), (Owners{1, 1}));
}

TEST(InitialOwners, JointsAreEdgesAndTheWorldIsNot) {
  World world = TwoColumns();
  world.joints = {Join(1, 1, 3), Join(2, 2, 0), Join(3, 4, 0)};
  EXPECT_EQ(InitialOwners(world, {Cube(1, -9), Cube(2, -3), Cube(3, 9, 0, 0, 5), Cube(4, 5)}, 0), (Owners{1, 0, 1, 1}));
}

TEST(InitialOwners, AgreesWithTestingAllPairs) {
  uint64_t state = 1;
  const auto random = [&state](double range) {
    state = state * 6364136223846793005u + 1442695040888963407u;
    return (static_cast<double>(state >> 33) / 0x1p31 - 0.5) * range;
  };
  const double x_edges[] = {-5, 0, 5}, z_edges[] = {0};
  const World world(*Layout::Grid(x_edges, z_edges));
  for (int round = 0; round < 50; ++round) {
    std::vector<BodyView> views;
    for (BodyId id = 1; id <= 60; ++id) views.push_back(Cube(id, random(20), random(4), random(12), 1 + random(1)));
    std::vector<int> label(views.size());
    for (size_t i = 0; i < views.size(); ++i) label[i] = static_cast<int>(i);
    for (bool changed = true; changed;) {
      changed = false;
      for (size_t i = 0; i < views.size(); ++i) {
        for (size_t j = 0; j < views.size(); ++j) {
          if (label[j] < label[i] && Overlap(views[i].box, views[j].box)) changed = true, label[i] = label[j];
        }
      }
    }
    Owners expected;
    for (size_t i = 0; i < views.size(); ++i) {
      std::vector<double> mass(world.layout.size());
      for (size_t j = 0; j < views.size(); ++j) {
        if (label[j] == label[i]) mass[world.layout.Home(views[j].centre)] += views[j].mass;
      }
      expected.push_back(static_cast<RegionId>(std::max_element(mass.begin(), mass.end()) - mass.begin()));
    }
    EXPECT_EQ(InitialOwners(world, views, 0), expected);
  }
}

TEST(InitialOwnersDeathTest, AJointToAnAbsentBodyStopsTheProcess) {
  World world = TwoColumns();
  world.joints = {Join(4, 1, 77)};
  EXPECT_DEATH(InitialOwners(world, {Cube(1, 0)}, 0), "joint 4 joins body 77");
}

}  // namespace
}  // namespace aureole
