// The watched bodies of a region as streams tell them, by cells: built from captures, off the tick thread.
#pragma once

#include <algorithm>
#include <array>
#include <deque>
#include <memory>
#include <string>
#include <vector>

#include <absl/container/flat_hash_map.h>

#include "server/transport/cell_encoder.h"
#include "server/transport/cell_state.h"
#include "server/transport/replica_capture.h"

namespace aureole {

class ReplicaScene {
 public:
  void Apply(const Capture& capture);

  Tick tick() const { return tick_; }
  // Of the watch that this is the state of.
  uint64_t watch_generation() const { return watch_ != nullptr ? watch_->generation : 0; }
  // Calls fn(const CellKey&) for every cell that has bodies, in no particular order.
  template <class Fn>
  void ForEachCell(Fn&& fn) const {
    for (const auto& [key, cell] : cells_) fn(key);
  }
  size_t cells() const { return cells_.size(); }
  // The state of a cell now; null when it is empty. While it does not change it is the same object.
  std::shared_ptr<const CellState> State(const CellKey& cell, Precision precision);
  // The serialised BodyDescription without the body; null when the body is not here.
  const std::string* Look(BodyId id) const;
  // The state in which a body last came into the cell from elsewhere than another cell; 0: none did.
  Tick LastArrival(const CellKey& cell) const;
  // Null when the body is not here.
  const CellKey* CellOfBody(BodyId id) const;
  // Where bodies went, since the last Forget.
  const Fates& fates() const { return fates_; }
  // Calls fn(const BodyChanges::Gone&) for every body that was handed over after state n, in order.
  template <class Fn>
  void ForEachHandOver(Tick n, Fn&& fn) const {
    auto it = std::lower_bound(handed_over_.begin(), handed_over_.end(), n,
                               [](const HandOver& h, Tick tick) { return h.tick <= tick; });
    for (; it != handed_over_.end(); ++it) fn(it->gone);
  }
  // Forgets fates and handed over bodies of ticks before n.
  void Forget(Tick n);

 private:
  struct Body {
    BodyPose pose;
    CellKey cell;
    bool placed = false;  // in the cell
    Epoch epoch = 0;
    std::string look;
    std::array<QuantisedPose, 2> quantised;  // by precision
    std::array<bool, 2> valid{};             // of these
  };
  struct Cell {
    std::vector<BodyId> ids;  // ascending
    uint64_t version = 1;     // grows with every change
    Tick arrival = 0;
    std::array<std::shared_ptr<const CellState>, 3> states;  // by precision
    std::array<uint64_t, 3> state_versions{};
  };

  void Remove(BodyId id);
  void Put(BodyId id, Body* body, const CellKey& cell);
  void TakeOut(BodyId id, const CellKey& cell);
  const QuantisedPose& Quantised(Body* body, Precision precision);

  Tick tick_ = 0;
  std::shared_ptr<const Watch> watch_;
  absl::flat_hash_map<BodyId, Body> bodies_;
  absl::flat_hash_map<CellKey, Cell> cells_;
  Fates fates_;
  struct HandOver {
    Tick tick = 0;  // of the capture that told it
    BodyChanges::Gone gone;
  };
  std::deque<HandOver> handed_over_;
};

}  // namespace aureole
