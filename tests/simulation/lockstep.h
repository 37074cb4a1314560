// Regions in lock-step without a network, for tests that ask who owns what.
#pragma once

#include <cstdio>
#include <cstdlib>
#include <map>
#include <memory>
#include <vector>

#include "server/core/region.h"
#include "server/core/toy_engine.h"
#include "server/core/undivided.h"

namespace aureole::sim {

class Lockstep {
 public:
  explicit Lockstep(World world, std::unique_ptr<Engine> (*make)(const Environment&) = MakeToyEngine)
      : world_(std::move(world)) {
    for (RegionId r = 0; r < world_.layout.size(); ++r) {
      regions_.push_back(std::make_unique<Region>(world_, r, make(world_.environment)));
    }
  }

  // A region that joins with this change, once it is in force; and one that is there no more.
  void Join(RegionId r, const LayoutChange& change) {
    if (static_cast<size_t>(r) >= regions_.size()) regions_.resize(static_cast<size_t>(r) + 1);
    regions_[r] = *Region::Join(world_, r, MakeToyEngine(world_.environment), change);
  }
  void Drop(RegionId r) { regions_[r] = nullptr; }

  // Until every region has stepped tick n, but those that have left, or have not joined yet.
  void RunTo(Tick n) {
    bool progress = true;
    while (progress) {
      progress = false;
      for (auto& r : regions_) {
        if (r == nullptr) continue;
        while (r->Ready() && !(r->phase() == Phase::kBegin && r->tick() >= n)) {
          Advance(*r);
          progress = true;
        }
      }
    }
    for (auto& r : regions_) {
      if (r != nullptr && r->phase() == Phase::kBegin && r->tick() != n) std::abort();
    }
  }

  // kNoRegion while it is in flight, or does not exist.
  RegionId Owner(BodyId id) const {
    RegionId owner = kNoRegion;
    for (const auto& r : regions_) {
      if (r != nullptr && r->engine().Contains(id)) owner = owner == kNoRegion ? r->self() : -100;
    }
    return owner;
  }
  Region& region(RegionId r) { return *regions_[r]; }
  const World& world() const { return world_; }
  int64_t BodiesMoved() const {
    int64_t n = 0;
    for (const auto& r : regions_) n += r == nullptr ? 0 : r->stats().bodies_out;
    return n;
  }
  uint64_t Hash() const {
    uint64_t sum = 0;
    for (const auto& r : regions_) sum += r == nullptr ? 0 : r->StateHash();
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

class Undivided : public aureole::Undivided {
 public:
  explicit Undivided(const World& world, std::unique_ptr<Engine> (*make)(const Environment&) = MakeToyEngine)
      : aureole::Undivided(world, make(world.environment)) {}
};

}  // namespace aureole::sim
