// The steps of the control plane from one layout to another, and the cells that operators' wishes mean.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "server/control/balanced_cells.h"
#include "server/control/layout_change.h"
#include "server/control/layout_desk.h"
#include "server/control/layout_plan.h"
#include "server/core/limits.h"
#include "server/core/partition.h"

namespace aureole {
namespace {

using Kind = LayoutStep::Kind;
using Members = std::vector<RegionId>;

constexpr double kInf = std::numeric_limits<double>::infinity();
const Rect kLeft{-kInf, 0, -kInf, kInf}, kRight{0, kInf, -kInf, kInf}, kAll{-kInf, kInf, -kInf, kInf};
const Rect kFarRight{5, kInf, -kInf, kInf}, kMiddle{0, 5, -kInf, kInf};

// Two regions that run.
LayoutObserved Two() {
  LayoutObserved o;
  o.now = {7, {kLeft, kRight}, {0, 1}, {0, 1}};
  o.regions = {{true, false, false, 7, 10}, {true, false, false, 7, 10}};
  return o;
}

// The same, and a third has been proposed.
LayoutObserved Joining() {
  LayoutObserved o = Two();
  o.wanted = {kLeft, kMiddle, kFarRight};
  o.proposed = NextLayoutStep(o).change;
  o.regions.push_back({true, true, false, 0, 0});
  return o;
}

TEST(LayoutSteps, NothingIsDoneWhereNothingElseIsWanted) {
  EXPECT_EQ(NextLayoutStep(Two()).kind, Kind::kNone);
  LayoutObserved o = Two();
  o.wanted = o.now.regions;
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kNone);
}

TEST(LayoutSteps, ARegionMoreIsProposedThenOfferedOnceItHasMetAll) {
  LayoutObserved o = Joining();
  EXPECT_EQ(o.proposed->epoch, 8u);
  EXPECT_EQ(o.proposed->members, (Members{0, 1, 2}));
  EXPECT_EQ(o.proposed->ranks, (std::vector<int>{0, 1, 2}));
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kOffer);
  EXPECT_EQ(NextLayoutStep(o).to, 0);
  o.regions[2].may_join = false;
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kNone);
  o.regions[2].may_join = true;
  o.regions[0].ready = false;
  EXPECT_EQ(NextLayoutStep(o).to, 1);
  o.offered = true;
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kNone);
}

TEST(LayoutSteps, AnAnswerOrAReportEndsAProposal) {
  LayoutObserved o = Joining();
  o.offered = o.accepted = true;
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kAdopt);
  o = Joining();
  o.regions[1].epoch = 8;  // whoever was asked died before it said so
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kAdopt);
  o = Joining();
  o.offered = o.refused = true;
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kDrop);
}

TEST(LayoutSteps, AProposalThatIsWithdrawnIsDropped) {
  LayoutObserved o = Joining();
  o.withdrawn = true;
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kDrop);
}

TEST(LayoutSteps, AStandInJoinsAsTheOtherLosesItsArea) {
  LayoutObserved o = Two();
  const absl::StatusOr<StandIn> stand_in = WithStandIn(o.now, 1);
  ASSERT_TRUE(stand_in.ok()) << stand_in.status();
  EXPECT_EQ(stand_in->region, 2);
  o.wanted = stand_in->regions;
  EXPECT_EQ(o.wanted, (std::vector<Rect>{kLeft, {}, kRight}));
  const LayoutChange change = NextLayoutStep(o).change;
  EXPECT_EQ(change.members, (Members{0, 1, 2}));
  EXPECT_EQ(change.regions, o.wanted);
}

TEST(LayoutSteps, ANameIsNotGivenAgainBeforeItIsFree) {
  LayoutObserved o = Two();
  o.now = {7, {kAll, {}}, {0, 1}, {0}};
  o.wanted = {kLeft, kRight};
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kNone);
  o.regions[1].free = true;
  EXPECT_EQ(NextLayoutStep(o).change.members, (Members{0, 1}));
}

TEST(LayoutSteps, ARegionLosesItsAreaThenItsBodiesThenItsMembership) {
  LayoutObserved o = Two();
  o.wanted = {kAll, {}};
  const LayoutChange first = NextLayoutStep(o).change;
  EXPECT_EQ(first.members, (Members{0, 1}));
  EXPECT_FALSE(first.regions[1].HasArea());
  o.now = first;
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kNone) << "it has bodies";
  o.regions[1].bodies = 0;
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kNone) << "that report is of the layout before";
  o.regions[1].epoch = 8;
  EXPECT_EQ(NextLayoutStep(o).kind, Kind::kPropose);
  EXPECT_EQ(NextLayoutStep(o).change.members, Members{0});
  EXPECT_EQ(NextLayoutStep(o).change.epoch, 9u);
}

World Square() {
  World world(*Layout::Columns({}));
  BodySpec body;
  for (double at : {-12.0, 12.0}) {
    body.position = {at, 0, at};
    world.bodies.push_back(body);
  }
  return world;
}

TEST(LayoutPlan, EqualCellsTileThePlane) {
  const World world = Square();
  const std::vector<Rect> cells = *EqualCells(world, 3, 2);
  ASSERT_EQ(cells.size(), 6u);
  EXPECT_EQ(cells[1], (Rect{-4, 4, -kInf, 0}));
  EXPECT_TRUE(Layout::Rectangles(cells).ok());
  EXPECT_EQ(EqualCells(world, 1, 1)->front(), kAll);
  EXPECT_FALSE(EqualCells(world, 0, 1).ok());
  EXPECT_FALSE(EqualCells(world, 10, 10).ok());
}

TEST(LayoutPlan, InjectedBodiesBeginInTheirVolumes) {
  World world = Square();
  Injector injector;
  injector.volumes.push_back({{-50, 0, 3}, {-40, 5, 4}});
  world.injectors.push_back(injector);
  EXPECT_EQ(WhereBodiesBegin(world), (Rect{-50, 12, -12, 12}));
  world.bodies.clear();
  EXPECT_EQ(WhereBodiesBegin(world), (Rect{-50, -40, -1.5, 8.5}));
  world.injectors.clear();
  EXPECT_EQ(WhereBodiesBegin(world), (Rect{-5, 5, -5, 5}));
}

TEST(BalancedCells, TileThePlaneForEveryCount) {
  const World world = Square();
  for (const bool columns : {true, false}) {
    for (const std::vector<double>& weights : {std::vector<double>{}, {0, 0}, {1, 0}, {3, 1e9}}) {
      for (int count = 1; count <= 64; ++count) {
        const std::vector<Rect> cells = BalancedCells(world, Two().now, weights, count, columns);
        ASSERT_EQ(cells.size(), static_cast<size_t>(count));
        EXPECT_TRUE(Layout::Rectangles(cells).ok()) << count;
        for (const Rect& r : cells) EXPECT_TRUE(!columns || std::isinf(r.min_z));
      }
    }
  }
}

TEST(BalancedCells, WithoutWeightsTheyAreOfEqualSize) {
  const std::vector<Rect> cells = BalancedCells(Square(), Two().now, {}, 4, false);
  EXPECT_NEAR(cells[0].max_x, 0, 1e-6);
  EXPECT_NEAR(cells[0].max_z, 0, 1e-6);
  EXPECT_NEAR(BalancedCells(Square(), Two().now, {}, 3, true)[0].max_x, -4, 1e-6);
}

// Where all is in a small place, changes of the layout find it: each sees more.
TEST(BalancedCells, CloseInOnACrowd) {
  const World world = Square();
  LayoutChange now = FirstLayout(world);
  const auto crowd = [](const Rect& r) {  // evenly in 3 m by 3 m
    const double x = std::min(r.max_x, 9.0) - std::max(r.min_x, 6.0),
                 z = std::min(r.max_z, 9.0) - std::max(r.min_z, 6.0);
    return x > 0 && z > 0 ? 100 * x * z / 9 : 0.0;
  };
  double busiest = 0;
  for (const int count : {2, 4, 5, 6, 7, 8}) {
    std::vector<double> weights;
    for (const Rect& r : now.regions) weights.push_back(crowd(r));
    const std::vector<Rect> cells = BalancedCells(world, now, weights, count, false);
    now.regions = AssignCells(now, cells);
    busiest = 0;
    for (const Rect& r : now.regions) busiest = std::max(busiest, crowd(r));
  }
  EXPECT_LT(busiest, 50);
  busiest = 0;
  const std::vector<Rect> equal = *EqualCells(world, 4, 2);
  for (const Rect& r : equal) busiest = std::max(busiest, crowd(r));
  EXPECT_EQ(busiest, 100) << "cells of equal size do not help";
}

TEST(LayoutDesk, ResizesToColumnsOrToCellsAsTheWorldBegan) {
  World world = Square();
  LayoutDesk columns(world);
  EXPECT_TRUE(columns.ResizeTo(4).ok());
  EXPECT_EQ(columns.wanted(), *EqualCells(world, 4, 1));
  EXPECT_TRUE(columns.ResizeTo(3, {1}).ok());
  const std::vector<Rect> three = columns.wanted();
  for (const Rect& r : three) EXPECT_TRUE(!r.HasArea() || std::isinf(r.min_z));
  const std::vector<double> edge = {0};
  world.layout = *Layout::Grid(edge, edge);
  LayoutDesk grid(world);
  EXPECT_TRUE(grid.ResizeTo(4).ok());
  EXPECT_TRUE(grid.wanted().empty()) << "there are as many";
  EXPECT_TRUE(grid.ResizeTo(6).ok());
  const std::vector<Rect> six = grid.wanted();
  EXPECT_EQ(std::count_if(six.begin(), six.end(), [](const Rect& r) { return r.max_z <= 0; }), 3);
  EXPECT_TRUE(absl::IsInvalidArgument(grid.ResizeTo(0)));
  EXPECT_TRUE(absl::IsInvalidArgument(grid.ResizeTo(65, {1})));
  world.exchange.k = 1;
  EXPECT_TRUE(absl::IsFailedPrecondition(grid.ResizeTo(5, {1})));
}

TEST(LayoutPlan, CellsGoToThoseThatHaveMostOfThem) {
  const LayoutChange now{1, {kRight, {}, kLeft}, {0, 1, 2}, {0, 2}};
  EXPECT_EQ(AssignCells(now, {kLeft, kMiddle, kFarRight}), (std::vector<Rect>{kFarRight, kMiddle, kLeft}));
  EXPECT_EQ(AssignCells(now, {kLeft, kMiddle, kFarRight}, {1}), (std::vector<Rect>{kFarRight, {}, kLeft, kMiddle}));
  EXPECT_EQ(AssignCells(now, {kAll}).size(), 3u);
}

TEST(LayoutPlan, AStandInIsTheLowestRegionThatIsFree) {
  const LayoutChange now{1, {{}, {}, kLeft, {}, kRight}, {0, 1, 2, 3, 4}, {0, 2, 4}};
  EXPECT_EQ(WithStandIn(now, 2)->region, 1) << "0 is a member still";
  EXPECT_EQ(WithStandIn(now, 4, {1, 3})->region, 5);
  EXPECT_EQ(WithStandIn(now, 4, {1, 3})->regions, (std::vector<Rect>{{}, {}, kLeft, {}, {}, kRight}));
  EXPECT_TRUE(absl::IsInvalidArgument(WithStandIn(now, 1).status()));
  EXPECT_TRUE(absl::IsInvalidArgument(WithStandIn(now, 9).status()));
  LayoutChange full = now;
  full.regions.resize(limits::kMaxRegions);
  std::vector<RegionId> busy;
  for (RegionId r = 0; r < limits::kMaxRegions; ++r) busy.push_back(r);
  EXPECT_TRUE(absl::IsResourceExhausted(WithStandIn(full, 4, busy).status()));
}

TEST(LayoutPlan, ANeighbourTakesTheAreaOfOneThatIsDrained) {
  const LayoutChange now{1, {kLeft, kMiddle, kFarRight}, {0, 1, 2}, {0, 1, 2}};
  EXPECT_EQ(*WithoutArea(now, 2), (std::vector<Rect>{kLeft, kRight, {}}));
  EXPECT_EQ(*WithoutArea(now, 1), (std::vector<Rect>{{-kInf, 5, -kInf, kInf}, {}, kFarRight}));
  EXPECT_FALSE(WithoutArea(now, 3).ok());
  EXPECT_FALSE(WithoutArea({1, {kAll}, {0}, {0}}, 0).ok());
}

}  // namespace
}  // namespace aureole
