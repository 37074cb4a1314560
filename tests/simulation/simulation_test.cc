// The slice of the cluster simulation that every test run includes.
#include <gtest/gtest.h>

#include "server/core/toy_engine.h"
#include "server/physics/bullet_engine.h"
#include "tests/simulation/cluster.h"

namespace aureole::sim {
namespace {

// Runs seeds until one is bad; adds up what they went through.
struct Sum {
  int64_t bad = 0, touching = 0, chains_of_3 = 0, chains_of_4 = 0, wakes = 0, returns = 0, reconnects = 0;
  int64_t graphs_again = 0, crashes = 0, replayed = 0, together = 0;
  int64_t layouts = 0, joined = 0, left = 0, refused_layouts = 0;
  std::string first;
};
Sum RunSeeds(uint64_t first, int seeds, const ScenarioOptions& options, const Faults& faults, bool stop = true,
             const EngineFactory& make_engine = MakeToyEngine) {
  Sum sum;
  for (uint64_t seed = first; seed < first + static_cast<uint64_t>(seeds); ++seed) {
    const Scenario s = MakeScenario(seed, options, make_engine);
    const Verdict v = RunCluster(s, seed, faults, make_engine);
    sum.bad += !v.ok;
    sum.touching += v.touching_transfers;
    sum.chains_of_3 += v.longest_chain >= 3;
    sum.chains_of_4 += v.longest_chain >= 4;
    sum.wakes += v.wakes;
    sum.returns += v.returns;
    sum.reconnects += v.reconnects;
    sum.graphs_again += v.graphs_again;
    sum.crashes += v.crashes;
    sum.replayed += v.replayed_ticks;
    sum.together += v.together;
    sum.layouts += v.layouts;
    sum.joined += v.joined;
    sum.left += v.left;
    sum.refused_layouts += v.refused_layouts;
    if (!v.ok) {
      sum.first =
          "seed " + std::to_string(seed) + " tick " + std::to_string(v.tick) + " " + v.invariant + ": " + v.message;
      if (stop) break;
    }
  }
  return sum;
}

TEST(ClusterSimulation, InvariantsHoldWithEveryDelayUnderAllFaults) {
  const Sum sum = RunSeeds(1, 1500, {}, Faults());
  EXPECT_EQ(sum.bad, 0) << sum.first;
  // An easy world is no proof.
  EXPECT_GT(sum.touching, 1500);
  EXPECT_GT(sum.chains_of_3, 50);
  EXPECT_GT(sum.wakes, 500);
  EXPECT_GT(sum.returns, 1500);
  EXPECT_GT(sum.reconnects, 500);
}

TEST(ClusterSimulation, CornersAndNarrowCellsHoldInTheSynchronousExchange) {
  ScenarioOptions options;
  options.k = 0;
  for (const char* layout : {"tee", "grid4", "grid9", "bricks"}) {
    options.layout = layout;
    const Sum sum = RunSeeds(5000, 300, options, Faults::None());
    EXPECT_EQ(sum.bad, 0) << layout << ": " << sum.first;
    EXPECT_GT(sum.chains_of_3, 10) << layout;
    EXPECT_GT(sum.graphs_again, 300) << layout;
  }
}

// R12: a struck row hands the speed, and light bodies more than that, to its far end in one tick.
TEST(ClusterSimulation, StruckRowsHoldInTheReachPolicy) {
  ScenarioOptions options;
  options.policy = AuraPolicy::kReach;
  options.scene = "cradle";
  for (int k : {1, 2, 3}) {
    options.k = k;
    const Sum sum = RunSeeds(10000, 200, options, Faults::None());
    EXPECT_EQ(sum.bad, 0) << "k " << k << ": " << sum.first;
  }
}

// Few of the worlds above meet what costs the fixed delay most: strangers deep in another region, pairs at top speed.
TEST(ClusterSimulation, HeapsAndDuelsHoldInTheTolerancePolicy) {
  ScenarioOptions options;
  options.policy = AuraPolicy::kTolerance;
  for (const char* scene : {"heap", "duels"}) {
    options.scene = scene;
    for (int k : {1, 2}) {
      options.k = k;
      const Sum sum = RunSeeds(10000, 150, options, Faults::None());
      EXPECT_EQ(sum.bad, 0) << scene << ", k " << k << ": " << sum.first;
    }
  }
}

TEST(ClusterSimulation, TheNetworkChangesNoBit) {
  for (uint64_t seed = 1; seed <= 60; ++seed) {
    const Scenario s = MakeScenario(seed, {}, MakeToyEngine);
    if (!s.live.empty()) continue;  // a live input takes effect when it arrives
    const Verdict calm = RunCluster(s, seed, Faults::None(), MakeToyEngine);
    const Verdict rough = RunCluster(s, seed, Faults(), MakeToyEngine);
    EXPECT_EQ(calm.hash, rough.hash) << "seed " << seed;
    EXPECT_EQ(calm.transfers, rough.transfers) << "seed " << seed;
  }
}

// A region is a pure function of its checkpoint, the frames of its peers and its inputs: it replays what it lost.
TEST(ClusterSimulation, RegionsThatDieBetweenAnyTwoPhasesGoOnBitForBit) {
  Faults faults;
  faults.crashes = true;
  const Sum sum = RunSeeds(20000, 400, {}, faults);
  EXPECT_EQ(sum.bad, 0) << sum.first;
  EXPECT_GT(sum.crashes, 2000);
  EXPECT_GT(sum.together, 400);
  EXPECT_GT(sum.replayed, 15000);
}

TEST(ClusterSimulation, BulletRegionsThatDieGoOnBitForBit) {
  Faults faults;
  faults.crashes = true;
  const Sum sum = RunSeeds(21000, 12, {}, faults, true, MakeBulletEngine);
  EXPECT_EQ(sum.bad, 0) << sum.first;
  EXPECT_GT(sum.crashes, 40);
}

// Borders move, regions join and leave, under all that the network does and while regions die: no bit changes.
TEST(ClusterSimulation, TheLayoutOfARunningWorldChangesBitForBit) {
  ScenarioOptions options;
  options.k = 0;
  Faults faults;
  faults.layouts = true;
  for (const bool crashes : {false, true}) {
    faults.crashes = crashes;
    const Sum sum = RunSeeds(30000, 300, options, faults);
    EXPECT_EQ(sum.bad, 0) << sum.first;
    EXPECT_GT(sum.layouts, 800);
    EXPECT_GT(sum.joined, 200);
    EXPECT_GT(sum.left, 150);
    EXPECT_GT(sum.refused_layouts, 50);
  }
}

TEST(ClusterSimulation, TheLayoutOfABulletWorldChangesBitForBit) {
  ScenarioOptions options;
  options.k = 0;
  Faults faults;
  faults.layouts = faults.crashes = true;
  const Sum sum = RunSeeds(31000, 12, options, faults, true, MakeBulletEngine);
  EXPECT_EQ(sum.bad, 0) << sum.first;
  EXPECT_GT(sum.layouts, 20);
}

// Without live inputs, whose tick depends on the layout only as it does on the network.
TEST(ClusterSimulation, ChangesOfTheLayoutChangeNoBitOfTheLastState) {
  Faults layouts = Faults::None();
  layouts.layouts = true;
  ScenarioOptions options;
  options.k = 0;
  int64_t changed = 0;
  for (uint64_t seed = 1; seed <= 60; ++seed) {
    const Scenario s = MakeScenario(seed, options, MakeToyEngine);
    if (!s.live.empty()) continue;
    const Verdict fixed = RunCluster(s, seed, Faults::None(), MakeToyEngine);
    const Verdict moving = RunCluster(s, seed, layouts, MakeToyEngine);
    EXPECT_EQ(fixed.hash, moving.hash) << "seed " << seed;
    changed += moving.layouts;
  }
  EXPECT_GT(changed, 80);
}

// Where three regions lie side by side, strangers of the outer two meet deep in the middle one: m = 2 is not enough on
// columns, however wide.
TEST(ClusterSimulation, ThreeColumnsNeedTheMarginOfThreeOwners) {
  ScenarioOptions options;
  options.k = 1;
  options.policy = AuraPolicy::kTolerance;
  options.layout = "columns4";
  options.scene = "scatter";
  const Margins two = ComputeMargins(1, 2);
  options.margin_overrides = {{"predict", two.predict},
                              {"give_back", two.give_back},
                              {"project", two.project},
                              {"spawn_notice", two.spawn_notice}};
  EXPECT_GT(RunSeeds(1, 4000, options, Faults::None()).bad, 0);
  options.margin_overrides.clear();
  const Sum sum = RunSeeds(1, 400, options, Faults::None());
  EXPECT_EQ(sum.bad, 0) << sum.first;
}

}  // namespace
}  // namespace aureole::sim
