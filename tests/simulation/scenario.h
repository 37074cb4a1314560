// Seeded worlds for the cluster simulation: small, crowded, and aimed at what the protocol finds hard.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>

#include "server/core/world.h"

namespace aureole::sim {

using EngineFactory = std::function<std::unique_ptr<Engine>(const Environment&)>;

struct ScenarioOptions {
  bool toy = true;
  std::optional<int> k;                            // else chosen by the seed from 0..3
  std::optional<AuraPolicy> policy;                // else chosen by the seed where k >= 1
  std::optional<std::string> scene;                // else chosen by the seed; see Scenes()
  std::optional<std::string> layout;               // else chosen by the seed; see Layouts()
  std::map<std::string, double> margin_overrides;  // field of Margins -> value instead of the computed one
  bool returns = true;                             // off: no island ever goes home
};

const std::vector<std::string>& Scenes();
const std::vector<std::string>& Layouts();

struct Scenario {
  explicit Scenario(World w) : world(std::move(w)) {}
  World world;
  std::string scene, layout;
  Tick ticks = 0;
  // Live inputs: tick after which it is offered to whichever region owns the body then.
  std::vector<Input> live;
};

// The scenario of a seed. Its scripted impulses are aimed by looking at the undivided run.
Scenario MakeScenario(uint64_t seed, const ScenarioOptions& options, const EngineFactory& make_engine);

}  // namespace aureole::sim
