// A world split over many engines, with its contact components dealt anew in every tick, keeps every bit.
#include <gtest/gtest.h>

#include "tests/physics/split_run.h"

namespace aureole {
namespace {

void ExpectEqual(const SplitResult& r) {
  EXPECT_EQ(r.difference, "");
  // An easy scene must not pass for a proof.
  EXPECT_GT(r.touching, 1000);
  EXPECT_GT(r.wakes, 50);
  EXPECT_GT(r.asleep, r.body_ticks / 20);
  EXPECT_LT(r.asleep, r.body_ticks * 19 / 20);
}

TEST(Migration, EveryTickOverThreeEnginesChangesNoBit) {
  SplitOptions o;
  ExpectEqual(RunSplit(MakePhysicsScene(1, 12, 15, 600), 600, o));
}

TEST(Migration, EveryTickOverFiveEnginesChangesNoBit) {
  SplitOptions o;
  o.engines = 5;
  o.seed = 2;
  ExpectEqual(RunSplit(MakePhysicsScene(2, 12, 15, 600), 600, o));
}

TEST(Migration, RareMovesChangeNoBit) {
  SplitOptions o;
  o.engines = 2;
  o.seed = 3;
  o.deal_every = 20;
  o.scratch = false;
  const SplitResult r = RunSplit(MakePhysicsScene(3, 12, 15, 600), 600, o);
  EXPECT_EQ(r.difference, "");
  EXPECT_GT(r.touching, 100);
}

TEST(Migration, CreationOrderAndUnrelatedBodiesChangeNoBit) {
  SplitOptions o;
  o.engines = 1;
  o.seed = 4;
  o.scratch = false;
  const SplitResult r = RunSplit(MakePhysicsScene(4, 12, 15, 400), 400, o);
  EXPECT_EQ(r.difference, "");
  EXPECT_EQ(r.moves, 0);
}

}  // namespace
}  // namespace aureole
