#include "client/cli/policies_report.h"

#include <algorithm>
#include <string>

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

namespace aureole {
namespace {

using testing::HasSubstr;
using testing::Not;

// Two servers over 100 ticks; the busier one has `ms`.
RunMeasure Measured(double ms) {
  RunMeasure m;
  m.regions.resize(2);
  m.regions[0].mean_frame_ms = ms / 2;
  m.regions[0].max_frame_ms = 100;
  m.regions[0].body_ticks = 3000;
  m.regions[1].mean_frame_ms = ms;
  m.regions[1].max_frame_ms = 3 * ms;
  m.regions[1].body_ticks = 1000;
  m.body_ticks = 4000;
  m.away_body_ticks = 20;
  m.bodies_moved = 6;
  m.home_crossings = 4;
  m.bytes_sent = 20000;
  m.waits = 300;
  m.wait_us = 50000;
  return m;
}

// A scene in which the exchanges take these times, in the order of kExchangeChoices, and one server 10 ms.
PolicyScene Scene(double density, const std::array<double, 5>& ms) {
  PolicyScene scene;
  scene.world = "crowd";
  scene.density = density;
  scene.ticks = 100;
  scene.reference.regions.resize(1);
  scene.reference.regions[0].mean_frame_ms = 10;
  for (size_t i = 0; i < ms.size(); ++i) {
    PolicyRun run{kExchangeChoices[i], Measured(ms[i]), {}};
    run.comparison.hash_equal = true;
    scene.runs.push_back(run);
  }
  return scene;
}

PolicyTable Table(std::vector<PolicyScene> scenes) {
  PolicyTable table;
  table.scenes = std::move(scenes);
  return table;
}

TEST(PoliciesReport, FiguresAreThoseOfTheBusiestServerAndPerTick) {
  const PolicyScene scene = Scene(0.2, {4, 5, 6, 7, 8});
  const PolicyFigures f = FiguresOf(scene.runs[0], scene);
  EXPECT_DOUBLE_EQ(f.away, 0.005);
  EXPECT_DOUBLE_EQ(f.most_hosted, 0.75);
  EXPECT_EQ(f.moves, 1.5);
  EXPECT_DOUBLE_EQ(f.mean_ms, 4);
  EXPECT_DOUBLE_EQ(f.max_ms, 12) << "of the server with the largest mean, not the largest of all";
  EXPECT_DOUBLE_EQ(f.of_one, 0.4);
  EXPECT_DOUBLE_EQ(f.waits, 1.5);
  EXPECT_DOUBLE_EQ(f.wait_ms, 0.25);
  EXPECT_DOUBLE_EQ(f.bytes, 100);
}

TEST(PoliciesReport, BarsAreThoseOfZeroDelayAndOfReachOneAtOneDensity) {
  for (const double density : {0.05, 0.2, 0.5, 1.0}) {
    for (const ExchangeChoice& e : kExchangeChoices) {
      const bool wanted = e.k == 0 || (e.k == 1 && e.reach && density == 0.2);
      EXPECT_EQ(BarOf(e, density).has_value(), wanted) << e.Name() << " at " << density;
    }
  }
  EXPECT_EQ(BarOf({1, true}, 0.2)->away, 0.03);
  EXPECT_EQ(BarOf({1, true}, 0.2)->moves, 4);
}

TEST(PoliciesReport, TableSaysWhichBarsAreMet) {
  PolicyScene scene = Scene(0.2, {4, 5, 6, 7, 8});
  scene.runs[0].measure.bodies_moved = 16;
  scene.runs[1].measure.away_body_ticks = 200;
  const std::string text = TableText(Table({scene}));
  EXPECT_THAT(text, HasSubstr("away <= 0.01 PASS, moves <= 3 miss\n"));
  EXPECT_THAT(text, HasSubstr("away <= 0.03 miss, moves <= 4 PASS\n"));
}

TEST(PoliciesReport, NoCrossingIsADashAndNull) {
  PolicyScene scene = Scene(0.5, {4, 5, 6, 7, 8});
  for (PolicyRun& run : scene.runs) run.measure.home_crossings = 0;
  EXPECT_FALSE(FiguresOf(scene.runs[0], scene).moves.has_value());
  EXPECT_TRUE(ToJson(Table({scene}))["scenes"][0]["runs"][0]["moves_per_home_crossing"].is_null());
}

TEST(PoliciesReport, RunThatDiffersIsNamedWithItsTickAndCannotWin) {
  PolicyTable table = Table({Scene(0.2, {4, 5, 6, 7, 8})});
  EXPECT_TRUE(table.Exact());
  EXPECT_THAT(TableText(table), Not(HasSubstr("NOT EXACT")));
  EXPECT_EQ(Fastest(table.scenes[0])->exchange.k, 0);
  table.scenes[0].runs[0].comparison.hash_equal = false;
  table.scenes[0].runs[0].comparison.first_difference = 300;
  EXPECT_FALSE(table.Exact());
  EXPECT_THAT(TableText(table),
              HasSubstr("0.2 bodies/m2, slow, k = 0: NOT EXACT: differs from the undivided run, first at tick 300"));
  EXPECT_EQ(Fastest(table.scenes[0])->exchange.Name(), "reach, k = 1");
  EXPECT_EQ(FastestOverall(table)->first.Name(), "reach, k = 1");
  EXPECT_EQ(ToJson(table)["scenes"][0]["runs"][0]["first_difference"], 300);
}

TEST(PoliciesReport, FastestOverallHasTheLowestMeanRatio) {
  const PolicyTable table = Table({Scene(0.05, {9, 5, 20, 20, 20}), Scene(1, {2, 8, 20, 20, 20})});
  EXPECT_EQ(Fastest(table.scenes[0])->exchange.Name(), "reach, k = 1");
  EXPECT_EQ(Fastest(table.scenes[1])->exchange.Name(), "k = 0");
  const auto best = FastestOverall(table);
  ASSERT_TRUE(best.has_value());
  EXPECT_EQ(best->first.Name(), "k = 0");
  EXPECT_DOUBLE_EQ(best->second, 0.55);
  EXPECT_THAT(TableText(table),
              HasSubstr("overall                  k = 0            0.550 of one server, on average\n"));
}

TEST(PoliciesReport, SceneThatWasInterruptedDoesNotDecide) {
  PolicyTable table = Table({Scene(0.05, {4, 5, 6, 7, 8})});
  table.scenes[0].runs.resize(3);
  EXPECT_FALSE(FastestOverall(table).has_value());
  EXPECT_THAT(TableText(table), Not(HasSubstr("overall")));
}

TEST(PoliciesReport, CsvHasALineForEachRun) {
  const std::string csv = ToCsv(Table({Scene(0.2, {4, 5, 6, 7, 8}), Scene(1, {4, 5, 6, 7, 8})}));
  EXPECT_EQ(std::count(csv.begin(), csv.end(), '\n'), 11);
  EXPECT_THAT(csv, HasSubstr("\ncrowd,0.2,slow,,0,1,0,0.005000,"));
  EXPECT_THAT(csv, HasSubstr("\ncrowd,0.2,slow,reach,1,1,0,0.005000,"));
  EXPECT_THAT(csv, HasSubstr("\ncrowd,1,slow,tolerance,2,1,0,0.005000,"));
}

}  // namespace
}  // namespace aureole
