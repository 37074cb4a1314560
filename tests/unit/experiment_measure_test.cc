#include "client/cli/measure.h"

#include <gtest/gtest.h>

namespace aureole {
namespace {

v1::Window Window(int64_t index, double max_ms, double mean_ms, int64_t ticks = 312, int64_t bodies = 10) {
  v1::Window w;
  w.set_index(index);
  w.set_bodies(bodies);
  w.mutable_process_cpu()->set_ticks(ticks);
  w.mutable_process_cpu()->set_max_ms(max_ms);
  w.mutable_process_cpu()->set_mean_ms(mean_ms);
  w.mutable_thread_cpu()->set_max_ms(max_ms / 2);
  return w;
}

TickSum Sum(Tick tick, uint64_t hash, int64_t bodies, int regions) { return {tick, hash, bodies, regions}; }

RunMeasure WithSums(int regions, std::vector<TickSum> sums) {
  RunMeasure m;
  m.regions.resize(static_cast<size_t>(regions));
  m.hashes = std::move(sums);
  for (TickSum& sum : m.hashes) sum.members = regions;
  return m;
}

TEST(ExperimentMeasure, WindowIsTheWorstServerOfEach) {
  RunResult result;
  result.status.regions.resize(2);
  result.windows = {{Window(0, 3, 2), Window(1, 7, 1)}, {Window(0, 5, 1), Window(1, 6, 4)}};
  const RunMeasure m = Measure(result, 16000);
  ASSERT_EQ(m.windows.size(), 2u);
  EXPECT_EQ(m.windows[0].t, 5);
  EXPECT_EQ(m.windows[0].max_frame_ms, 5);
  EXPECT_EQ(m.windows[0].mean_frame_ms, 2);
  EXPECT_EQ(m.windows[0].max_thread_ms, 2.5);
  EXPECT_EQ(m.windows[0].slowest, 1);
  EXPECT_EQ(m.windows[0].bodies, 20);
  EXPECT_EQ(m.windows[1].t, 10);
  EXPECT_EQ(m.windows[1].slowest, 0);
  EXPECT_EQ(m.LastMaxFrameMs(), 7);
  EXPECT_EQ(m.regions[1].last_max_frame_ms, 6);
}

TEST(ExperimentMeasure, SlackIsCountedOverAllRegions) {
  RunResult result;
  result.status.regions.resize(3);
  for (int n : {1, 0, 8, 0}) result.status.regions[0].report.add_slack(n);
  for (int n : {0, 0, 90, 5}) result.status.regions[2].report.add_slack(n);
  const std::optional<SlackQuantiles> q = QuantilesOf(Measure(result, 16000).slack);
  ASSERT_TRUE(q.has_value());
  EXPECT_EQ(q->met, 99);
  EXPECT_EQ(q->never, 5);
  EXPECT_EQ(q->min, 0);
  EXPECT_EQ(q->p1, 0);
  EXPECT_EQ(q->p50, 2);
  EXPECT_EQ(q->p99, 2);
  EXPECT_FALSE(QuantilesOf({}).has_value());
  EXPECT_FALSE(QuantilesOf({0, 0, 7}).has_value()) << "none of them met anybody";
}

TEST(ExperimentMeasure, FramesOfARegionAreThoseOfTheWholeRun) {
  RunResult result;
  result.status.regions.resize(2);
  result.status.regions[1].report.set_body_ticks(70);
  result.windows = {{Window(0, 3, 2, 300), Window(1, 99, 6, 100)}, {Window(0, 5, 1)}};
  const RunMeasure m = Measure(result, 16000);
  EXPECT_DOUBLE_EQ(m.regions[0].mean_frame_ms, 3) << "each tick counts alike";
  EXPECT_EQ(m.regions[0].max_frame_ms, 99);
  EXPECT_EQ(m.regions[1].mean_frame_ms, 1);
  EXPECT_EQ(m.regions[1].body_ticks, 70);
  RunMeasure slower = m;
  slower.regions[0].mean_frame_ms = 5;
  slower.regions[0].max_frame_ms = 1;
  const RunMeasure mean = MedianOf(std::vector{m, slower});
  EXPECT_DOUBLE_EQ(mean.regions[0].mean_frame_ms, 4);
  EXPECT_DOUBLE_EQ(mean.regions[0].max_frame_ms, 50);
}

TEST(ExperimentMeasure, RepeatThatDiffersSpeaksForAll) {
  const RunMeasure want = WithSums(1, {Sum(100, 5, 10, 1)});
  const RunMeasure same = WithSums(1, {Sum(100, 5, 10, 1)}), other = WithSums(1, {Sum(100, 6, 9, 1)});
  EXPECT_TRUE(CompareAll(std::vector{same, same}, want, 100).hash_equal);
  const Comparison c = CompareAll(std::vector{same, other, same}, want, 100);
  EXPECT_FALSE(c.hash_equal);
  EXPECT_EQ(c.first_difference, 100);
  EXPECT_EQ(c.lost, 1);
}

TEST(ExperimentMeasure, LastWindowThatTheRunHardlyFilledIsLeftOut) {
  RunResult result;
  result.status.regions.resize(1);
  result.windows = {{Window(0, 3, 2), Window(1, 99, 99, 20)}};
  EXPECT_EQ(Measure(result, 16000).windows.size(), 1u);
  result.windows = {{Window(0, 3, 2, 20)}};
  EXPECT_EQ(Measure(result, 16000).windows.size(), 1u) << "but the only one is kept";
}

TEST(ExperimentMeasure, TotalsAreSumsAndLargestValuesOverRegions) {
  RunResult result;
  result.status.regions.resize(2);
  v1::Report& a = result.status.regions[0].report;
  v1::Report& b = result.status.regions[1].report;
  a.set_bodies(3), b.set_bodies(4);
  a.set_largest_cluster(9), b.set_largest_cluster(5);
  a.set_body_ticks(300), b.set_body_ticks(100);
  a.set_away_body_ticks(3), b.set_away_body_ticks(1);
  a.set_bodies_moved(6), a.set_home_crossings(3), b.set_transfers(3);
  const RunMeasure m = Measure(result, 16000);
  EXPECT_EQ(m.bodies, 7);
  EXPECT_EQ(m.largest_cluster, 9);
  EXPECT_DOUBLE_EQ(m.AwayFromHome(), 0.01);
  EXPECT_EQ(m.TransfersPerHomeCrossing(), 1.0);
  EXPECT_EQ(m.MovesPerHomeCrossing(), 2.0);
  EXPECT_FALSE(RunMeasure().TransfersPerHomeCrossing().has_value());
  EXPECT_FALSE(RunMeasure().MovesPerHomeCrossing().has_value());
}

TEST(ExperimentMeasure, OfRepeatsTheMedianCounts) {
  RunMeasure a, b, c;
  a.windows = {{5, 4, 2, 0, 0, 0, 0, 10}};
  b.windows = {{5, 8, 4, 0, 0, 0, 0, 10}};
  c.windows = {{5, 99, 1, 0, 0, 0, 0, 10}};
  b.violations = 2;
  EXPECT_EQ(MedianOf(std::vector{a, b}).windows[0].max_frame_ms, 6) << "of two, their mean";
  const RunMeasure m = MedianOf(std::vector{a, b, c});
  EXPECT_EQ(m.windows[0].max_frame_ms, 8);
  EXPECT_EQ(m.windows[0].mean_frame_ms, 2);
  EXPECT_EQ(m.windows[0].bodies, 10);
  EXPECT_EQ(m.violations, 2);
}

TEST(ExperimentCompare, EqualSumsAtEveryTickAreEqual) {
  const RunMeasure undivided = WithSums(1, {Sum(100, 5, 7, 1), Sum(150, 6, 7, 1)});
  const Comparison c = Compare(WithSums(2, {Sum(100, 5, 7, 2), Sum(150, 6, 7, 2)}), undivided, 150);
  EXPECT_TRUE(c.hash_equal);
  EXPECT_EQ(c.ticks, 2);
  EXPECT_EQ(c.first_difference, 0);
}

TEST(ExperimentCompare, FirstDifferenceIsNamed) {
  const RunMeasure undivided = WithSums(1, {Sum(100, 5, 7, 1), Sum(200, 6, 7, 1), Sum(300, 7, 7, 1)});
  const Comparison c = Compare(WithSums(2, {Sum(100, 5, 7, 2), Sum(200, 1, 7, 2), Sum(300, 7, 7, 2)}), undivided, 300);
  EXPECT_FALSE(c.hash_equal);
  EXPECT_EQ(c.first_difference, 200);
}

TEST(ExperimentCompare, TickThatARegionDidNotReportIsADifference) {
  const RunMeasure undivided = WithSums(1, {Sum(100, 5, 7, 1)});
  EXPECT_FALSE(Compare(WithSums(2, {Sum(100, 5, 7, 1)}), undivided, 100).hash_equal);
  EXPECT_FALSE(Compare(WithSums(2, {}), undivided, 100).hash_equal);
}

TEST(ExperimentCompare, RunWithoutASumAtItsEndIsNotEqual) {
  const RunMeasure undivided = WithSums(1, {Sum(100, 5, 7, 1)});
  EXPECT_FALSE(Compare(WithSums(2, {Sum(100, 5, 7, 2)}), undivided, 150).hash_equal);
}

TEST(ExperimentCompare, LostAndDoubledAreTheWorstTicks) {
  const RunMeasure undivided = WithSums(1, {Sum(1, 0, 10, 1), Sum(2, 0, 10, 1), Sum(3, 0, 10, 1)});
  const Comparison c = Compare(WithSums(2, {Sum(1, 0, 8, 2), Sum(2, 0, 13, 2), Sum(3, 0, 10, 2)}), undivided, 3);
  EXPECT_EQ(c.lost, 2);
  EXPECT_EQ(c.doubled, 3);
}

}  // namespace
}  // namespace aureole
