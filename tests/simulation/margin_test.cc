// Each margin of PROTOCOL.md's table does something: cut to its last violated value, the simulation notices.
#include <gtest/gtest.h>

#include "server/core/toy_engine.h"
#include "tests/simulation/cluster.h"

namespace aureole::sim {
namespace {

struct Cut {
  const char* name;
  int k;
  AuraPolicy policy;
  const char* layout;
  const char* scene;
  std::map<std::string, double> margins;
  bool returns;
  int seeds;
};

void PrintTo(const Cut& c, std::ostream* out) { *out << c.name; }

class Margin : public testing::TestWithParam<Cut> {};

int64_t BadSeeds(const Cut& c, bool cut) {
  ScenarioOptions options;
  options.k = c.k;
  options.policy = c.policy;
  options.layout = c.layout;
  options.scene = c.scene;
  options.returns = c.returns;
  if (cut) options.margin_overrides = c.margins;
  int64_t bad = 0;
  for (int seed = 1; seed <= c.seeds && (bad == 0 || !cut); ++seed) {
    const Scenario s = MakeScenario(static_cast<uint64_t>(seed), options, MakeToyEngine);
    bad += !RunCluster(s, static_cast<uint64_t>(seed), Faults::None(), MakeToyEngine).ok;
  }
  return bad;
}

TEST_P(Margin, CutToItsLastViolatedValueIsCaught) {
  EXPECT_GT(BadSeeds(GetParam(), true), 0) << "of " << GetParam().seeds << " seeds none broke";
}

TEST_P(Margin, AsComputedHoldsOnTheSameSeeds) {
  Cut c = GetParam();
  c.seeds = std::min(c.seeds, 300);
  EXPECT_EQ(BadSeeds(c, false), 0);
}

constexpr AuraPolicy kTolerance = AuraPolicy::kTolerance, kReach = AuraPolicy::kReach;

// D_pred on a plain border at the values that PROTOCOL.md's bisection found violated last. The spawn notice at 2k-1: at
// 3k-2 the protocol's model broke once in thousands of seeds. D_pred at a corner breaks two seeds in 3,000 at 2 of 3
// steps.
INSTANTIATE_TEST_SUITE_P(
    Table, Margin,
    testing::Values(Cut{"PredictK1", 1, kTolerance, "columns2", "duels", {{"predict", 0.97}}, false, 400},
                    Cut{"PredictK2", 2, kTolerance, "columns2", "duels", {{"predict", 3.97}}, false, 400},
                    Cut{"PredictK3", 3, kTolerance, "columns2", "duels", {{"predict", 6.97}}, false, 400},
                    Cut{"PredictCornerK1", 1, kTolerance, "grid4", "burst", {{"predict", 2}}, false, 6000},
                    Cut{"GiveBackK2", 2, kTolerance, "columns2", "scatter", {{"give_back", 4}}, true, 3000},
                    Cut{"ProjectK2", 2, kTolerance, "columns2", "duels", {{"project", 4}}, false, 400},
                    Cut{"ProjectWithReturnK2", 2, kTolerance, "columns2", "scatter", {{"project", 8}}, true, 6000},
                    Cut{"NoticeK1", 1, kTolerance, "columns2", "duels", {{"spawn_notice", 1}}, false, 1000},
                    Cut{"NoticeK2", 2, kTolerance, "columns2", "duels", {{"spawn_notice", 3}}, false, 2000},
                    Cut{"NoticeK3", 3, kTolerance, "columns2", "duels", {{"spawn_notice", 5}}, false, 2000},
                    Cut{"HorizonK2", 2, kReach, "columns2", "duels", {{"horizon", 2}}, false, 100},
                    Cut{"HorizonK3", 3, kReach, "columns2", "duels", {{"horizon", 4}}, false, 100}),
    [](const testing::TestParamInfo<Cut>& param) { return param.param.name; });

}  // namespace
}  // namespace aureole::sim
