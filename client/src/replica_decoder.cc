#include "client/src/replica_decoder.h"

#include <algorithm>
#include <cmath>

namespace aureole::client {
namespace {

constexpr double kCellSize = 32;  // m

struct Units {
  double position, orientation, velocity;
};

Units UnitsOf(v1::Precision p) {
  return p == v1::COARSE ? Units{1.0 / 128, 1.0 / 512, 1.0 / 8} : Units{1.0 / 2048, 1.0 / 4096, 1.0 / 64};
}

int32_t Plus(int32_t a, int32_t b) { return static_cast<int32_t>(static_cast<uint32_t>(a) + static_cast<uint32_t>(b)); }

class BitReader {
 public:
  explicit BitReader(const std::string& bits) : bits_(bits) {}
  // Zeros after the end.
  uint32_t Read(int n) {
    uint32_t out = 0;
    for (int i = 0; i < n; ++i, ++at_) {
      if (at_ / 8 < bits_.size() && static_cast<uint8_t>(bits_[at_ / 8]) >> at_ % 8 & 1) out |= uint32_t{1} << i;
    }
    return out;
  }
  int32_t ReadSigned(int n) {
    const uint32_t value = Read(n);
    if (n == 0 || n == 32) return static_cast<int32_t>(value);
    return static_cast<int32_t>(value) - static_cast<int32_t>((value >> (n - 1) & 1) << n);
  }
  bool AtEnd() const { return at_ + 8 > bits_.size() * 8; }

 private:
  const std::string& bits_;
  size_t at_ = 0;
};

}  // namespace

bool ReplicaDecoder::Apply(const v1::ReplicaFrame& frame, std::string* error) {
  changed_.clear();
  lost_.clear();
  if (frame.base_tick() != tick_) {
    *error = "a frame after tick " + std::to_string(frame.base_tick()) + " where tick " + std::to_string(tick_) +
             " was the last";
    return false;
  }
  if (frame.tick() <= tick_ || frame.dropped_size() % 2 != 0) {
    *error = "a frame of tick " + std::to_string(frame.tick()) + " after tick " + std::to_string(tick_);
    return false;
  }
  for (int i = 0; i < frame.dropped_size(); i += 2) {
    const auto cell = cells_.find({frame.dropped(i), frame.dropped(i + 1)});
    if (cell == cells_.end()) continue;
    for (const Entry& e : cell->second) {
      if (where_[e.id] == cell->first) lost_.push_back({e.id});
    }
    cells_.erase(cell);
  }
  for (const v1::Cell& cell : frame.cells()) {
    if (ApplyCell(frame, cell)) continue;
    *error = "cell " + std::to_string(cell.x()) + ", " + std::to_string(cell.z()) + " of tick " +
             std::to_string(frame.tick()) + ": " + error_;
    return false;
  }
  if (frame.passed_region_size() != frame.passed_size() || frame.passed_epoch_size() != frame.passed_size() ||
      frame.passed_tick_size() != frame.passed_size()) {
    *error = "columns of passed bodies of different lengths";
    return false;
  }
  tick_ = frame.tick();
  // What is in another cell now is not lost.
  std::erase_if(lost_, [this](const LostBody& l) {
    const auto at = where_.find(l.body);
    if (at == where_.end()) return true;
    const auto cell = cells_.find(at->second);
    if (cell != cells_.end() && Find(&cell->second, l.body) != nullptr) return true;
    where_.erase(at);
    return false;
  });
  uint64_t id = 0;
  for (int i = 0; i < frame.passed_size(); ++i) {
    lost_.push_back({id += frame.passed(i), LostBody::Why::kMoved, static_cast<int32_t>(frame.passed_region(i)),
                     frame.passed_epoch(i), tick_ + frame.passed_tick(i)});
  }
  return true;
}

ToldBody ReplicaDecoder::Get(uint64_t body) const {
  const Cell& cell = cells_.at(where_.at(body));
  const Entry& e = *Find(const_cast<Cell*>(&cell), body);
  ToldBody out;
  out.epoch = e.epoch;
  out.asleep = e.asleep;
  if (precision_ == v1::EXACT) {
    std::copy_n(e.exact.begin(), 3, out.position.begin());
    std::copy_n(e.exact.begin() + 3, 4, out.orientation.begin());
    std::copy_n(e.exact.begin() + 7, 3, out.velocity.begin());
    std::copy_n(e.exact.begin() + 10, 3, out.angular_velocity.begin());
    return out;
  }
  const Units u = UnitsOf(precision_);
  double rest = 1;
  for (size_t i = 0; i < 3; ++i) {
    out.position[i] = e.integers[i] * u.position;
    out.velocity[i] = e.integers[6 + i] * u.velocity;
    out.angular_velocity[i] = e.integers[9 + i] * u.velocity;
  }
  for (size_t from = 3, to = 0; to < 4; ++to) {
    if (to == e.largest) continue;
    out.orientation[to] = e.integers[from++] * u.orientation;
    rest -= out.orientation[to] * out.orientation[to];
  }
  out.orientation[e.largest] = std::sqrt(std::max(0.0, rest));
  return out;
}

bool ReplicaDecoder::ApplyCell(const v1::ReplicaFrame& frame, const v1::Cell& in) {
  const CellKey key{in.x(), in.z()};
  Cell& cell = cells_[key];
  if (!Change(in, &cell) || !TakeOut(frame, in, key, &cell) || !Add(in, key, &cell)) return false;
  uint64_t id = 0;
  for (uint64_t step : in.slept()) {
    if (Entry* e = Find(&cell, id += step)) {
      e->asleep = true;
      changed_.push_back(id);
    }
  }
  id = 0;
  for (uint64_t step : in.woke()) {
    if (Entry* e = Find(&cell, id += step)) {
      e->asleep = false;
      changed_.push_back(id);
    }
  }
  if (cell.empty()) cells_.erase(key);
  return true;
}

bool ReplicaDecoder::Change(const v1::Cell& in, Cell* cell) {
  if (!in.bits().empty()) return ReadBits(in.bits(), cell);
  const int n = in.id_size();
  if (precision_ == v1::EXACT) {
    if (in.exact_size() != 13 * (n + in.new_id_size())) return Fail("exact has not 13 values per body");
  } else if (in.position_size() != 3 * n || in.orientation_size() != 3 * n ||
             in.velocity_size() != (velocities_ ? 6 * n : 0)) {
    return Fail("columns of different lengths");
  }
  uint64_t id = 0;
  for (int i = 0; i < n; ++i) {
    Entry* e = Find(cell, id += in.id(i));
    if (e == nullptr) return Fail("a difference for a body that is not there");
    changed_.push_back(id);
    if (precision_ == v1::EXACT) {
      std::copy_n(in.exact().begin() + 13 * (in.new_id_size() + i), 13, e->exact.begin());
      continue;
    }
    for (int k = 0; k < 3; ++k) {
      const auto at = static_cast<size_t>(k);
      e->integers[at] = Plus(e->integers[at], in.position(3 * i + k));
      e->integers[3 + at] = Plus(e->integers[3 + at], in.orientation(3 * i + k));
    }
    for (int k = 0; k < 6 && velocities_; ++k) {
      const auto at = static_cast<size_t>(6 + k);
      e->integers[at] = Plus(e->integers[at], in.velocity(6 * i + k));
    }
  }
  return true;
}

bool ReplicaDecoder::ReadBits(const std::string& bits, Cell* cell) {
  static constexpr int kWidths[] = {0, 4, 6, 8, 10, 12, 14, 32};
  BitReader reader(bits);
  for (Entry& e : *cell) {
    if (reader.Read(1) == 0) continue;
    changed_.push_back(e.id);
    for (size_t k = 0; k < (velocities_ ? 12 : 6); k += 3) {
      const int width = kWidths[reader.Read(3)];
      for (size_t i = k; i < k + 3; ++i) e.integers[i] = Plus(e.integers[i], reader.ReadSigned(width));
    }
  }
  return reader.AtEnd() || Fail("bits of more bodies than are there");
}

bool ReplicaDecoder::TakeOut(const v1::ReplicaFrame& frame, const v1::Cell& in, const CellKey& key, Cell* cell) {
  if (in.why_size() != in.gone_size() || in.moved_tick_size() != in.moved_epoch_size()) {
    return Fail("gone bodies without a reason");
  }
  uint64_t id = 0;
  int moved = 0;
  for (int i = 0; i < in.gone_size(); ++i) {
    const Entry* e = Find(cell, id += in.gone(i));
    if (e == nullptr) return Fail("a body is gone that was not there");
    LostBody lost{id};
    if (in.why(i) == 1) lost.why = LostBody::Why::kRemoved;
    if (in.why(i) >= 2) {
      if (moved >= in.moved_tick_size()) return Fail("moved bodies without their tick");
      lost.why = LostBody::Why::kMoved;
      lost.region = static_cast<int32_t>(in.why(i) - 2);
      lost.epoch = in.moved_epoch(moved);
      lost.tick = frame.tick() + in.moved_tick(moved++);
    }
    cell->erase(cell->begin() + (e - cell->data()));
    if (where_[id] == key) lost_.push_back(lost);
  }
  return true;
}

bool ReplicaDecoder::Add(const v1::Cell& in, const CellKey& key, Cell* cell) {
  const int n = in.new_id_size();
  const bool exact = precision_ == v1::EXACT;
  if (in.new_epoch_size() != n) return Fail("new bodies without an epoch");
  if (!exact && (in.new_position_size() != 3 * n || in.new_orientation_size() != 3 * n || in.new_largest_size() != n ||
                 in.new_velocity_size() != (velocities_ ? 6 * n : 0))) {
    return Fail("columns of new bodies of different lengths");
  }
  const double corner = kCellSize / UnitsOf(precision_).position;
  uint64_t id = 0;
  for (int i = 0; i < n; ++i) {
    id += in.new_id(i);
    auto at = std::lower_bound(cell->begin(), cell->end(), id, [](const Entry& e, uint64_t x) { return e.id < x; });
    if (at == cell->end() || at->id != id) {
      at = cell->insert(at, Entry());
      at->id = id;
    }
    Entry& e = *at;
    e.epoch = in.new_epoch(i);
    where_[id] = key;
    changed_.push_back(id);
    if (exact) {
      std::copy_n(in.exact().begin() + 13 * i, 13, e.exact.begin());
      continue;
    }
    if (in.new_largest(i) > 3) return Fail("an orientation without its largest component");
    e.largest = static_cast<uint8_t>(in.new_largest(i));
    for (int k = 0; k < 3; ++k) {
      e.integers[static_cast<size_t>(k)] = in.new_position(3 * i + k);
      e.integers[static_cast<size_t>(3 + k)] = in.new_orientation(3 * i + k);
    }
    e.integers[0] = Plus(e.integers[0], static_cast<int32_t>(key.first * corner));
    e.integers[2] = Plus(e.integers[2], static_cast<int32_t>(key.second * corner));
    for (int k = 0; k < 6 && velocities_; ++k) e.integers[static_cast<size_t>(6 + k)] = in.new_velocity(6 * i + k);
  }
  return true;
}

ReplicaDecoder::Entry* ReplicaDecoder::Find(Cell* cell, uint64_t id) {
  const auto at = std::lower_bound(cell->begin(), cell->end(), id, [](const Entry& e, uint64_t x) { return e.id < x; });
  return at != cell->end() && at->id == id ? &*at : nullptr;
}

bool ReplicaDecoder::Fail(const char* what) {
  error_ = what;
  return false;
}

}  // namespace aureole::client
