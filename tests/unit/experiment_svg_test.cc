#include "client/cli/svg_plot.h"

#include <gtest/gtest.h>

#include <set>

namespace aureole {
namespace {

TEST(ExperimentSvg, TicksAreRoundAndCoverTheLargestValue) {
  EXPECT_EQ(RoundTicks(60, 12), (std::vector<double>{0, 5, 10, 15, 20, 25, 30, 35, 40, 45, 50, 55, 60}));
  EXPECT_EQ(RoundTicks(7, 8).back(), 7);
  EXPECT_EQ(RoundTicks(73, 8), (std::vector<double>{0, 10, 20, 30, 40, 50, 60, 70, 80}));
  for (const double v : {0.003, 0.9, 1.0, 41.7, 12345.0}) {
    EXPECT_GE(RoundTicks(v, 8).back(), v);
    EXPECT_LE(RoundTicks(v, 8).size(), 9u);
  }
  EXPECT_GE(RoundTicks(0, 8).size(), 2u) << "an empty chart has an axis too";
}

TEST(ExperimentSvg, PointsAreDrawnToScale) {
  // y runs from 0 at the bottom (416) to 10 at the top (76), x from 0 (64) to 10 (584).
  const std::string svg = RenderSvg("t", {{"c", "x", "y", 5, {{"s", {{0, 0}, {5, 10}, {10, 5}}}}}});
  EXPECT_NE(svg.find("points=\"64.0,416.0 324.0,76.0 584.0,246.0 \""), std::string::npos) << svg;
}

TEST(ExperimentSvg, TextIsEscaped) {
  const std::string svg = RenderSvg("a<b & \"c\"", {});
  EXPECT_NE(svg.find(">a&lt;b &amp; &quot;c&quot;<"), std::string::npos) << svg;
}

TEST(ExperimentSvg, TenCurvesHaveTenColoursAndTheIdealIsDashed) {
  Chart chart{"c", "x", "y", 1, {}};
  for (int i = 0; i < 10; ++i) chart.series.push_back({"s", {{1.0, 1.0 + i}}});
  chart.series.push_back({"ideal", {{1, 1}, {2, 2}}, true});
  const std::string svg = RenderSvg("t", {chart});
  std::set<std::string> colours;
  for (size_t at = svg.find("r=\"2.6\" fill=\""); at != std::string::npos; at = svg.find("r=\"2.6\" fill=\"", at + 1)) {
    colours.insert(svg.substr(at + 14, 7));
  }
  EXPECT_EQ(colours.size(), 10u);
  EXPECT_NE(svg.find("stroke-dasharray"), std::string::npos);
}

}  // namespace
}  // namespace aureole
