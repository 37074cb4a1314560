#include "server/core/partition.h"

#include <array>
#include <limits>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace aureole {
namespace {

using testing::HasSubstr;
constexpr double kInf = std::numeric_limits<double>::infinity();

TEST(Layout, EveryPointHasOneHomeAndEdgesBelongToTheRight) {
  const Layout l = *Layout::Grid(std::array{0.0, 10.0}, std::array{0.0});
  ASSERT_EQ(l.size(), 6);
  EXPECT_EQ(l.Home(-1, -1), 0);
  EXPECT_EQ(l.Home(0, -1), 1);
  EXPECT_EQ(l.Home(10, -1), 2);
  EXPECT_EQ(l.Home(0, 0), 4);
  EXPECT_EQ(l.Home(1e12, 1e12), 5);
  for (double x : {-5.0, 0.0, 3.0, 10.0, 11.0}) {
    for (double z : {-2.0, 0.0, 2.0}) {
      int homes = 0;
      for (RegionId r = 0; r < l.size(); ++r) homes += l.rect(r).Contains(x, z);
      EXPECT_EQ(homes, 1) << x << " " << z;
    }
  }
}

TEST(Layout, RectanglesThatOverlapOrLeaveAHoleAreRefusedWithThePlace) {
  EXPECT_THAT(std::string(Layout::Rectangles({{-kInf, 1, -kInf, kInf}, {0, kInf, -kInf, kInf}}).status().message()),
              HasSubstr("overlaps regions[0]"));
  EXPECT_THAT(std::string(Layout::Rectangles({{-kInf, 0, -kInf, kInf}, {1, kInf, -kInf, kInf}}).status().message()),
              HasSubstr("none covers the point (x 0.5"));
  EXPECT_THAT(std::string(Layout::Columns(std::array{3.0, 2.0}).status().message()), HasSubstr("edges[1]"));
}

TEST(Layout, RanksMustBeAPermutation) {
  Layout l = *Layout::Columns(std::array{0.0});
  EXPECT_FALSE(l.SetRanks({0, 0}).ok());
  EXPECT_FALSE(l.SetRanks({0}).ok());
  ASSERT_TRUE(l.SetRanks({1, 0}).ok());
  EXPECT_EQ(l.rank(0), 1);
}

TEST(Layout, ChainNumberCountsTheRegionsThatComeCloseToOnePoint) {
  EXPECT_EQ(Layout::Columns({})->ChainNumber(1), 1);
  EXPECT_EQ(Layout::Columns(std::array{0.0})->ChainNumber(1), 2);
  EXPECT_EQ(Layout::Columns(std::array{0.0, 4.0, 8.0})->ChainNumber(1), 2);
  EXPECT_EQ(Layout::Columns(std::array{0.0, 4.0, 8.0})->ChainNumber(2), 3);
  EXPECT_EQ(Layout::Grid(std::array{0.0}, std::array{0.0})->ChainNumber(1), 4);
  EXPECT_EQ(Layout::Bricks(std::array{-20.0, 20.0}, std::array{0.0})->ChainNumber(1), 3) << "bricks have no crosses";
}

}  // namespace
}  // namespace aureole
