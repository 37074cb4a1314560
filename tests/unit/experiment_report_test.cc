#include "client/cli/experiment_report.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <nlohmann/json.hpp>

#include "client/cli/experiment.h"

namespace aureole {
namespace {

RunMeasure LastWindow(double ms, int regions) {
  RunMeasure m;
  m.windows = {{5, ms / 2, ms / 4, 0, 0, 0, 0, 50}, {10, ms, ms / 2, 0, 0, 0, 0, 100}};
  m.bodies = 100;
  for (int i = 0; i < regions; ++i) m.regions.push_back({i, i == 1 ? ms : ms / 2, 100 / regions, 20 + i, 30 + i, 2});
  return m;
}

Experiment TwoRuns(double split_ms) {
  Experiment e;
  e.references = {{"column-1", LastWindow(40, 1)}};
  Row one;
  one.world = "column-1";
  one.is_reference = true;
  one.measure = LastWindow(40, 1);
  one.comparison.hash_equal = true;
  Row four;
  four.world = "column-4";
  four.regions = 4;
  four.measure = LastWindow(split_ms, 4);
  four.comparison.hash_equal = true;
  e.rows = {one, four};
  return e;
}

TEST(ExperimentReport, AimIsOneAndAHalfOfTheIdealInColumnsAndTwiceAtCorners) {
  Row row;
  row.regions = 4;
  EXPECT_DOUBLE_EQ(row.Aim(), 0.375);
  row.figure = Figure::kCorners;
  row.regions = 9;
  EXPECT_DOUBLE_EQ(row.Aim(), 2.0 / 9);
}

TEST(ExperimentReport, TableNamesTheRegionThatMissedTheAimAndItsClusters) {
  const std::string text = TableText(TwoRuns(20));
  EXPECT_NE(text.find("column-4: 0.50 of one server, aim 0.38. Region 1 was slowest"), std::string::npos) << text;
  EXPECT_NE(text.find("largest component over several owners had 31 bodies, its largest transfer 21"),
            std::string::npos)
      << text;
}

TEST(ExperimentReport, RatioIsTheMedianOfThoseOfTheRounds) {
  Row row;
  row.measure = LastWindow(10, 1);
  const Reference reference{"one", LastWindow(40, 1)};
  EXPECT_DOUBLE_EQ(row.Ratio(reference), 0.25);
  row.ratios = {0.3, 0.2, 9};
  EXPECT_DOUBLE_EQ(row.Ratio(reference), 0.3);
}

TEST(ExperimentReport, TableHasBothFrameTimesTheirRatioAndTheIdeal) {
  const std::string text = TableText(TwoRuns(12));
  EXPECT_NE(text.find("last max ms one server ms  ratio ideal 1/n ratio/ideal\n"), std::string::npos) << text;
  EXPECT_NE(text.find("      12.00         40.00  0.300     0.250        1.20\n"), std::string::npos) << text;
}

TEST(ExperimentReport, TableIsSilentWhereTheAimIsMet) {
  EXPECT_EQ(TableText(TwoRuns(12)).find("aim"), std::string::npos);
}

TEST(ExperimentReport, DifferenceIsSaidWithItsTick) {
  Experiment e = TwoRuns(12);
  e.rows[1].comparison = {false, 300, 5, 0, 0};
  EXPECT_FALSE(e.rows[1].Exact());
  EXPECT_NE(TableText(e).find("column-4: differs from the undivided run, first at tick 300"), std::string::npos);
}

TEST(ExperimentReport, JsonHasWhatTheRunsMeasured) {
  Experiment e = TwoRuns(12);
  e.rows[1].measure.home_crossings = 4;
  e.rows[1].measure.bodies_moved = 6;
  const nlohmann::ordered_json json = ToJson(e);
  const auto& run = json["runs"][1];
  EXPECT_EQ(run["world"], "column-4");
  EXPECT_EQ(run["regions"], 4);
  EXPECT_EQ(run["bodies"], 100);
  EXPECT_EQ(run["hash_equal"], true);
  EXPECT_EQ(run["lost"], 0);
  EXPECT_EQ(run["doubled"], 0);
  EXPECT_EQ(run["violations"], 0);
  EXPECT_EQ(run["moves_per_home_crossing"], 1.5);
  EXPECT_TRUE(run["slack_at_first_touch"].is_null()) << "nobody met anybody";
  EXPECT_DOUBLE_EQ(run["ratio"], 0.3);
  EXPECT_EQ(run["windows"].size(), 2u);
  EXPECT_EQ(run["windows"][1]["t"], 10.0);
  EXPECT_EQ(run["windows"][1]["max_frame_ms"], 12.0);
  EXPECT_EQ(run["windows"][1]["mean_frame_ms"], 6.0);
  EXPECT_TRUE(json["runs"][0]["transfers_per_home_crossing"].is_null());
  EXPECT_TRUE(json["runs"][0]["moves_per_home_crossing"].is_null());
}

TEST(ExperimentReport, CsvHasALineForEachWindowAndTheReferenceOnce) {
  const std::string csv = ToCsv(TwoRuns(12));
  EXPECT_EQ(std::count(csv.begin(), csv.end(), '\n'), 1 + 2 + 2);
  EXPECT_NE(csv.find("\ncolumn-1,undivided,1,10,40.0000,"), std::string::npos) << csv;
  EXPECT_NE(csv.find("\ncolumn-4,split,4,10,12.0000,"), std::string::npos) << csv;
}

TEST(ExperimentReport, FigureHasACurveForEachNumberOfServersAndTheIdeal) {
  const std::string svg = ToSvg(TwoRuns(12), Figure::kColumns);
  for (const char* text : {">1 server<", ">4 servers<", ">ideal 1/n<", ">simulated time, s<", ">max frame time, ms<"}) {
    EXPECT_NE(svg.find(text), std::string::npos) << text;
  }
  EXPECT_EQ(ToSvg(TwoRuns(12), Figure::kCorners), "");
}

TEST(ExperimentContent, LayoutNameAndExchangeDoNotMatterAndTheRestDoes) {
  v1::WorldSpec a;
  a.set_name("a");
  a.add_injectors()->set_rate(160);
  v1::WorldSpec b = a;
  b.set_name("b");
  b.mutable_layout()->mutable_columns()->add_edges(1);
  b.mutable_exchange()->set_delay(2);
  EXPECT_EQ(ContentKey(a), ContentKey(b));
  b.set_seed(2);
  EXPECT_NE(ContentKey(a), ContentKey(b));
  b = a;
  b.mutable_injectors(0)->set_rate(161);
  EXPECT_NE(ContentKey(a), ContentKey(b));
}

}  // namespace
}  // namespace aureole
