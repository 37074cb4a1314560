#include "server/core/aura.h"

#include <gtest/gtest.h>

namespace aureole {
namespace {

TEST(PaperAura, GivesThePapersFigures) {
  const PaperAura a = ComputePaperAura({.speed = 32, .frame_us = 15000, .latency_us = 2000, .tick_us = 16000});
  EXPECT_EQ(a.remote_us, 32000);
  EXPECT_EQ(a.host_us, 48000);
  EXPECT_EQ(a.total_us, 80000);
  EXPECT_DOUBLE_EQ(a.Radius(0.3, 32), 0.3 + 32 * 0.08);
}

TEST(PaperAura, CeilingIsExactWhereDoublesAreNot) {
  // P4: in doubles ceil((2 * 0.027 + 0.016) / 0.010) is 8.
  EXPECT_EQ(ComputePaperAura({.frame_us = 27000, .latency_us = 16000, .tick_us = 10000}).remote_us, 70000);
  // P5: one microsecond more costs three ticks.
  EXPECT_EQ(ComputePaperAura({.frame_us = 15000, .latency_us = 2001, .tick_us = 16000}).total_us, 128000);
}

TEST(Margins, AreThoseOfTheProtocolsTable) {
  EXPECT_EQ(ComputeMargins(1, 2).predict, 1);
  EXPECT_EQ(ComputeMargins(2, 2).predict, 4);
  EXPECT_EQ(ComputeMargins(3, 2).predict, 7);
  EXPECT_EQ(ComputeMargins(2, 3).predict, 8);
  EXPECT_EQ(ComputeMargins(3, 4).predict, 19);
  EXPECT_EQ(ComputeMargins(2, 2).give_back, 8);
  EXPECT_EQ(ComputeMargins(2, 2).project, 12);
  EXPECT_EQ(ComputeMargins(2, 2).spawn_notice, 5);
  EXPECT_EQ(ComputeMargins(3, 4).horizon, 11);
}

TEST(ExchangeDelay, IsTwoForThePapersTolerances) {
  EXPECT_EQ(ExchangeDelay({.frame_us = 15000, .latency_us = 2000, .skew_us = 0, .tick_us = 16000}), 2);
  EXPECT_EQ(ExchangeDelay({.frame_us = 8000, .latency_us = 1000, .skew_us = 0, .tick_us = 16000}), 1);
}

}  // namespace
}  // namespace aureole
