// Reads the frames of one StreamReplicas stream (proto/aureole/v1/simulation.proto) back into bodies.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#include "aureole/v1/simulation.pb.h"

namespace aureole::client {

// A body as one server tells it. World frame, SI units.
struct ToldBody {
  std::array<double, 3> position{};     // of the centre of mass
  std::array<double, 4> orientation{};  // x, y, z, w; unit length
  std::array<double, 3> velocity{}, angular_velocity{};
  uint32_t epoch = 0;
  bool asleep = false;
};

// A body that a stream tells no more.
struct LostBody {
  enum class Why { kOutOfView, kRemoved, kMoved };
  uint64_t body = 0;
  Why why = Why::kOutOfView;
  int32_t region = -1;  // kMoved: where it is now, its epoch there, and the first tick there that has it
  uint32_t epoch = 0;
  int64_t tick = 0;
};

class ReplicaDecoder {
 public:
  // As the stream was asked for.
  ReplicaDecoder(v1::Precision precision, bool velocities) : precision_(precision), velocities_(velocities) {}

  // Takes the next frame. False when it is not one that can follow; then `error` says why, and the stream has to be
  // begun anew with a new decoder. Cost: linear in the frame, and with BITS in the bodies of its cells.
  bool Apply(const v1::ReplicaFrame& frame, std::string* error);

  int64_t tick() const { return tick_; }
  size_t bodies() const { return where_.size(); }
  bool Contains(uint64_t body) const { return where_.contains(body); }
  // Precondition: Contains(body).
  ToldBody Get(uint64_t body) const;
  template <class Fn>
  void ForEach(Fn&& fn) const {
    for (const auto& [body, cell] : where_) fn(body);
  }
  // Of the last frame: bodies that are new or have changed, and that this stream tells no more, those that only passed
  // among them. In no order.
  const std::vector<uint64_t>& changed() const { return changed_; }
  const std::vector<LostBody>& lost() const { return lost_; }

 private:
  using CellKey = std::pair<int32_t, int32_t>;
  struct Entry {
    uint64_t id = 0;
    uint32_t epoch = 0;
    std::array<int32_t, 12> integers{};  // position in the world, orientation, velocities
    std::array<double, 13> exact{};
    uint8_t largest = 3;
    bool asleep = false;
  };
  using Cell = std::vector<Entry>;  // ascending ids

  bool ApplyCell(const v1::ReplicaFrame& frame, const v1::Cell& cell);
  bool Change(const v1::Cell& in, Cell* cell);
  bool ReadBits(const std::string& bits, Cell* cell);
  bool TakeOut(const v1::ReplicaFrame& frame, const v1::Cell& in, const CellKey& key, Cell* cell);
  bool Add(const v1::Cell& in, const CellKey& key, Cell* cell);
  static Entry* Find(Cell* cell, uint64_t id);
  bool Fail(const char* what);

  const v1::Precision precision_;
  const bool velocities_;
  int64_t tick_ = 0;
  std::map<CellKey, Cell> cells_;
  std::unordered_map<uint64_t, CellKey> where_;
  std::vector<uint64_t> changed_;
  std::vector<LostBody> lost_;
  std::string error_;
};

}  // namespace aureole::client
