// One world: everything a WorldSpec says, validated and in the core's own types. Every region holds the same value.
#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "server/core/aura.h"
#include "server/core/injector.h"
#include "server/core/partition.h"
#include "server/core/scene.h"

namespace aureole {

enum class AuraPolicy : uint8_t {
  kTolerance = 0,  // the paper's: every body may move at the speed tolerance
  kReach = 1,      // R12: how far a body can get, or make others get
};

// How regions exchange. k = 0: the synchronous exchange (PROTOCOL.md section 10); no policy, no tolerances. k >= 1: the
// fixed-delay exchange.
struct Exchange {
  int k = 0;
  AuraPolicy policy = AuraPolicy::kTolerance;
  // k = 0 (R20), metres: an island goes home when nothing that is foreign or stays is nearer (D_ret); a body stays
  // while its box is no further outside of its owner's region than the slack. Both only decide how often bodies move.
  double return_gap = 0.125;
  double home_slack = 0.2;
  // Ticks that a body stays at least before an island gives it back; < 0: 8 at k = 0 (R20), 4k at k >= 1 (R6).
  int dwell = -1;
  // k >= 1: what a solver may move a body in one tick beyond its speed, to push it out of another; metres.
  double recovery = 0.02;
  Tick Dwell() const { return dwell >= 0 ? dwell : k == 0 ? 8 : 4 * k; }
  // k >= 1: replaces ComputeMargins, to measure what each margin is for.
  std::optional<Margins> margins;
};

struct World {
  std::string name;
  uint64_t seed = 1;
  Environment environment;
  Tolerances tolerances;  // tick_us equals environment.tick_us
  Exchange exchange;
  Layout layout;
  std::vector<BodySpec> bodies;   // dynamic, present in state 0
  std::vector<JointSpec> joints;  // between bodies of state 0
  std::vector<Injector> injectors;
  std::vector<Input> script;  // fixed inputs, sorted by Input's order; source 0

  explicit World(Layout l) : layout(std::move(l)) {}
};

// The scripted inputs of tick n, injected spawns after the fixed ones, in their order; appended. With k >= 1 a spawn
// whose notice cannot be kept (tick < 8k) is delayed to tick 8k, as a rule of the world (R11): the undivided reference
// delays it too.
void ScriptedInputs(const World& world, Tick n, std::vector<Input>* out);

// Who owns each body of state 0: every component (boxes within `margin` metres of each other, joints) goes whole to the
// region that is home to most of its mass, ties to the better rank. `views` ascending by id. A pure function: each
// region computes it.
std::vector<RegionId> InitialOwners(const World& world, const std::vector<BodyView>& views, double margin);

// m, the number of owners that margins must allow for in one chain (PROTOCOL.md section 1); 2..4.
int ChainNumberFor(const World& world);

// The margins of a world with k >= 1: those of its exchange if it names any, else computed for its layout's chain
// number.
Margins MarginsFor(const World& world);

// What one body adds to the world's state hash.
uint64_t BodyHash(BodyId id, uint64_t hash);

}  // namespace aureole
