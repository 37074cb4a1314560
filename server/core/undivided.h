// A world in one piece: the engine without any aura code. What every split run must equal, bit for bit.
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include <absl/status/statusor.h>

#include "server/core/engine.h"
#include "server/core/input_schedule.h"
#include "server/core/world.h"

namespace aureole {

class Undivided {
 public:
  // From state 0 of the world, which outlives it.
  Undivided(const World& world, std::unique_ptr<Engine> engine);
  // From the state after tick n, which `states` (RegionSnapshot) make up. InvalidArgument when they are none, or have a
  // body twice.
  static absl::StatusOr<Undivided> Resume(const World& world, std::unique_ptr<Engine> engine, Tick n,
                                          std::span<const std::string> states);

  // Takes effect at its tick, which is to come (or, of a force, goes on).
  void Add(const Input& input) { live_.Add(input); }
  void RunTo(Tick n);

  Tick tick() const { return tick_; }
  const Engine& engine() const { return *engine_; }
  // As the sum of Region::StateHash over all regions.
  uint64_t Hash() const;

 private:
  Undivided(const World& world, std::unique_ptr<Engine> engine, Tick n);

  const World* world_;
  std::unique_ptr<Engine> engine_;
  InputSchedule live_;
  Tick tick_ = 0;
};

}  // namespace aureole
