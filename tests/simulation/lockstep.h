// Regions in lock-step without a network, for tests that ask who owns what.
#pragma once

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <memory>
#include <vector>

#include "server/core/apply_input.h"
#include "server/core/input_schedule.h"
#include "server/core/region.h"
#include "server/core/toy_engine.h"

namespace aureole::sim {

class Lockstep {
 public:
  explicit Lockstep(World world, std::unique_ptr<Engine> (*make)(const Environment&) = MakeToyEngine)
      : world_(std::move(world)) {
    for (RegionId r = 0; r < world_.layout.size(); ++r) {
      regions_.push_back(std::make_unique<Region>(world_, r, make(world_.environment)));
    }
  }

  // Until every region has stepped tick n.
  void RunTo(Tick n) {
    bool progress = true;
    while (progress) {
      progress = false;
      for (auto& r : regions_) {
        while (r->Ready() && !(r->phase() == Phase::kBegin && r->tick() >= n)) {
          Advance(*r);
          progress = true;
        }
      }
    }
    for (auto& r : regions_) {
      if (r->tick() != n) std::abort();
    }
  }

  // kNoRegion while it is in flight, or does not exist.
  RegionId Owner(BodyId id) const {
    RegionId owner = kNoRegion;
    for (const auto& r : regions_) {
      if (r->engine().Contains(id)) owner = owner == kNoRegion ? r->self() : -100;
    }
    return owner;
  }
  Region& region(RegionId r) { return *regions_[r]; }
  const World& world() const { return world_; }
  int64_t BodiesMoved() const {
    int64_t n = 0;
    for (const auto& r : regions_) n += r->stats().bodies_out;
    return n;
  }
  uint64_t Hash() const {
    uint64_t sum = 0;
    for (const auto& r : regions_) sum += r->StateHash();
    return sum;
  }
  // Frames of the last tick, by (from, to).
  const std::vector<Frame>& LastFrames() const { return last_; }

 private:
  void Advance(Region& r) {
    std::vector<Frame> out;
    r.Advance(&out);
    for (Frame& f : out) {
      for (RegionId p : f.to) {
        const absl::Status s = regions_[p]->Receive(f);
        if (!s.ok()) {
          std::fprintf(stderr, "%s\n", std::string(s.message()).c_str());
          std::abort();
        }
      }
      if (!last_.empty() && f.tick > last_.front().tick) last_.clear();
      if (last_.empty() || f.tick == last_.front().tick) last_.push_back(std::move(f));
    }
  }

  const World world_;
  std::vector<std::unique_ptr<Region>> regions_;
  std::vector<Frame> last_;
};

// The same world in one piece: the engine without any aura code.
class Undivided {
 public:
  explicit Undivided(const World& world, std::unique_ptr<Engine> (*make)(const Environment&) = MakeToyEngine)
      : world_(world), engine_(make(world.environment)) {
    for (const BodySpec& b : world.bodies) engine_->Spawn(b);
    for (const JointSpec& j : world.joints) engine_->Join(j);
  }
  // Takes effect at its tick, which is to come.
  void Add(const Input& input) { live_.Add(input); }
  void RunTo(Tick n) {
    while (tick_ < n) {
      std::vector<Input> inputs;
      ScriptedInputs(world_, ++tick_, &inputs);
      live_.AppendDue(tick_, &inputs);
      std::sort(inputs.begin(), inputs.end());
      for (const Input& i : inputs) ApplyInput(i, engine_.get());
      engine_->Step(tick_);
    }
  }
  uint64_t Hash() const {
    uint64_t sum = 0;
    for (BodyId id : engine_->Ids()) sum += BodyHash(id, engine_->Hash(id));
    return sum;
  }
  const Engine& engine() const { return *engine_; }

 private:
  const World& world_;
  std::unique_ptr<Engine> engine_;
  InputSchedule live_;
  Tick tick_ = 0;
};

}  // namespace aureole::sim
