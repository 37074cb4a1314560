// The steps of the control plane from one layout to another, and the cells that operators' wishes mean.
#include <gtest/gtest.h>

#include <limits>

#include "server/control/layout_change.h"
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
