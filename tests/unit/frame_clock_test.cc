// The measures of a tick: percentiles, windows of simulated time, CPU and waits.
#include "server/region/frame_clock.h"

#include <gtest/gtest.h>

namespace aureole {
namespace {

TEST(FrameClock, SummaryHasMeanPercentileAndMaximum) {
  std::vector<double> ms;
  for (int i = 200; i >= 1; --i) ms.push_back(i);
  const v1::FrameTime s = Summarise(&ms);
  EXPECT_EQ(s.ticks(), 200);
  EXPECT_DOUBLE_EQ(s.mean_ms(), 100.5);
  EXPECT_DOUBLE_EQ(s.p99_ms(), 198);  // two of 200 are larger
  EXPECT_DOUBLE_EQ(s.max_ms(), 200);
  std::vector<double> none;
  EXPECT_EQ(Summarise(&none).ticks(), 0);
  std::vector<double> one = {3};
  EXPECT_DOUBLE_EQ(Summarise(&one).p99_ms(), 3);
}

TEST(FrameClock, WindowHoldsTheTicksThatBeginInIt) {
  WindowMeter meter(16000);  // 312.5 ticks in 5 s
  EXPECT_EQ(meter.WindowOf(1), 0);
  EXPECT_EQ(meter.WindowOf(313), 0);  // begins at 4.992 s
  EXPECT_EQ(meter.WindowOf(314), 1);  // begins at 5.008 s
  EXPECT_TRUE(meter.EndsAt(313));
  EXPECT_FALSE(meter.EndsAt(312));
  meter.Add({1, 2, 3});
  meter.Add({3, 4, 5});
  const v1::Window window = meter.Take(313);
  EXPECT_EQ(window.index(), 0);
  EXPECT_DOUBLE_EQ(window.process_cpu().max_ms(), 3);
  EXPECT_DOUBLE_EQ(window.thread_cpu().mean_ms(), 3);
  EXPECT_DOUBLE_EQ(window.wall().max_ms(), 5);
  EXPECT_EQ(meter.Take(314).process_cpu().ticks(), 0);
}

TEST(FrameClock, WorkIsCpuTimeAndWaitsAreNotWallTime) {
  FrameClock clock;
  volatile double sink = 0;
  for (int i = 0; i < 3'000'000; ++i) sink = sink + 1;
  const FrameSample work = clock.Lap();
  EXPECT_GT(work.thread_cpu, 0);
  EXPECT_GE(work.process_cpu, work.thread_cpu * 0.9);
  clock.AddWait(1e6);
  EXPECT_EQ(clock.Lap().wall, 0);
}

}  // namespace
}  // namespace aureole
