#include "server/transport/cell_encoder.h"

#include <algorithm>
#include <array>
#include <cstdlib>
#include <utility>

#include "aureole/v1/simulation.pb.h"

namespace aureole {
namespace {

using Ids = google::protobuf::RepeatedField<uint64_t>;

// Whole positions are told from the cell's corner, in steps.
std::array<int32_t, 3> FromCorner(const CellKey& key, const QuantisedPose& pose, Precision precision) {
  const double steps = kCellSize / (precision == Precision::kFine ? kFineQuanta : kCoarseQuanta).position;
  return {pose.position[0] - static_cast<int32_t>(key.x * steps), pose.position[1],
          pose.position[2] - static_cast<int32_t>(key.z * steps)};
}

class IdColumn {
 public:
  explicit IdColumn(Ids* out) : out_(out) {}
  void Add(BodyId id) { out_->Add(id - std::exchange(last_, id)); }

 private:
  Ids* out_;
  BodyId last_ = 0;
};

class BitWriter {
 public:
  void Add(uint32_t value, int bits) {
    for (int i = 0; i < bits; ++i, ++size_) {
      if (size_ % 8 == 0) bytes_.push_back(0);
      if (value >> i & 1) {
        bytes_.back() = static_cast<char>(bytes_.back() | 1 << size_ % 8);
        used_ = bytes_.size();
      }
    }
  }
  // Up to the last bit that is set.
  std::string Take() {
    bytes_.resize(used_);
    return std::move(bytes_);
  }

 private:
  std::string bytes_;
  size_t size_ = 0, used_ = 0;
};

// That a vector is told in; all three components in the same.
constexpr std::array<int, 8> kWidths{0, 4, 6, 8, 10, 12, 14, 32};

bool Fits(int32_t value, int bits) {
  if (bits >= 32) return true;
  const int64_t most = int64_t{1} << bits >> 1;
  return bits == 0 ? value == 0 : value >= -most && value < most;
}

void AddVector(const int32_t* d, BitWriter* out) {
  uint32_t choice = 0;
  while (!Fits(d[0], kWidths[choice]) || !Fits(d[1], kWidths[choice]) || !Fits(d[2], kWidths[choice])) ++choice;
  out->Add(choice, 3);
  for (int i = 0; i < 3; ++i) out->Add(static_cast<uint32_t>(d[i]), kWidths[choice]);
}

// Differences of all integers: position, orientation, velocities.
std::array<int32_t, 12> Difference(const QuantisedPose& from, const QuantisedPose& to) {
  // Modulo 2^32, as readers add.
  const auto minus = [](int32_t a, int32_t b) {
    return static_cast<int32_t>(static_cast<uint32_t>(a) - static_cast<uint32_t>(b));
  };
  std::array<int32_t, 12> d{};
  for (int i = 0; i < 3; ++i) {
    d[i] = minus(to.position[i], from.position[i]);
    d[3 + i] = minus(to.orientation[i], from.orientation[i]);
  }
  for (int i = 0; i < 6; ++i) d[6 + i] = minus(to.velocity[i], from.velocity[i]);
  return d;
}

class Encoder {
 public:
  Encoder(const CellFormat& format, const Fates& fates, Tick tick) : format_(format), fates_(fates), tick_(tick) {}

  EncodedCell Encode(const CellState* base, const CellState* state) {
    static const CellState kEmpty;
    const CellState &from = base != nullptr ? *base : kEmpty, &to = state != nullptr ? *state : kEmpty;
    key_ = base != nullptr ? base->key : state->key;
    size_t i = 0, j = 0;
    while (i < from.bodies.size() || j < to.bodies.size()) {
      const bool old = j == to.bodies.size() || (i < from.bodies.size() && from.bodies[i].id < to.bodies[j].id);
      const bool fresh = i == from.bodies.size() || (j < to.bodies.size() && to.bodies[j].id < from.bodies[i].id);
      if (old) {
        Leave(from.bodies[i++].id);
      } else if (fresh) {
        Enter(to, j++);
      } else {
        Keep(from, i++, to, j++);
      }
    }
    if (format_.precision == Precision::kExact) {
      for (const BodyPose* p : whole_) AddExact(*p);
      for (const BodyPose* p : changed_) AddExact(*p);
    }
    if (format_.layout == CellLayout::kBits) out_.set_bits(bits_.Take());
    if (out_.ByteSizeLong() > 0) {
      out_.set_x(key_.x);
      out_.set_z(key_.z);
      result_.bytes = out_.SerializeAsString();
    }
    return std::move(result_);
  }

 private:
  bool exact() const { return format_.precision == Precision::kExact; }

  void Leave(BodyId id) {
    result_.left.push_back(id);
    gone_.Add(id);
    if (format_.layout == CellLayout::kBits) bits_.Add(0, 1);
    const auto fate = fates_.find(id);
    if (fate == fates_.end()) return out_.add_why(0);
    const BodyChanges::Gone& g = fate->second;
    if (g.to == kNoRegion) return out_.add_why(1);
    out_.add_why(2 + static_cast<uint32_t>(g.to));
    out_.add_moved_epoch(g.epoch);
    out_.add_moved_tick(static_cast<int32_t>(g.from - tick_));
  }

  void Enter(const CellState& to, size_t j) {
    result_.entered.push_back(to.bodies[j].id);
    AddWhole(to, j);
    if (to.bodies[j].pose.asleep) slept_.Add(to.bodies[j].id);
  }

  void AddWhole(const CellState& to, size_t j) {
    const CellBody& b = to.bodies[j];
    new_id_.Add(b.id);
    out_.add_new_epoch(b.epoch);
    if (exact()) return whole_.push_back(&to.exact[j]);
    for (int32_t v : FromCorner(key_, b.pose, format_.precision)) out_.add_new_position(v);
    for (int32_t v : b.pose.orientation) out_.add_new_orientation(v);
    out_.add_new_largest(b.pose.largest);
    if (!format_.velocities) return;
    for (int32_t v : b.pose.velocity) out_.add_new_velocity(v);
  }

  void Keep(const CellState& from, size_t i, const CellState& to, size_t j) {
    const CellBody &x = from.bodies[i], &y = to.bodies[j];
    if (x.pose.asleep != y.pose.asleep) (y.pose.asleep ? slept_ : woke_).Add(y.id);
    const bool whole = x.epoch != y.epoch || x.pose.largest != y.pose.largest;
    if (whole) AddWhole(to, j);
    if (exact()) {
      if (!whole && !SameBits(from.exact[i], to.exact[j])) {
        id_.Add(y.id);
        changed_.push_back(&to.exact[j]);
      }
      return;
    }
    const std::array<int32_t, 12> d = Difference(x.pose, y.pose);
    const auto end = d.begin() + (format_.velocities ? 12 : 6);
    const bool changed = !whole && std::any_of(d.begin(), end, [](int32_t v) { return v != 0; });
    if (format_.layout == CellLayout::kBits) {
      bits_.Add(changed ? 1 : 0, 1);
      if (!changed) return;
      for (size_t k = 0; k < (format_.velocities ? 12 : 6); k += 3) AddVector(&d[k], &bits_);
    } else if (changed) {
      id_.Add(y.id);
      out_.mutable_position()->Add(&d[0], &d[3]);
      out_.mutable_orientation()->Add(&d[3], &d[6]);
      if (format_.velocities) out_.mutable_velocity()->Add(&d[6], &d[6] + 6);
    }
  }

  static bool SameBits(const BodyPose& x, const BodyPose& y) {
    return x.position == y.position && x.orientation.coeffs() == y.orientation.coeffs() && x.velocity == y.velocity &&
           x.angular_velocity == y.angular_velocity;
  }

  void AddExact(const BodyPose& p) {
    const auto add = [this](const double* v, int n) { out_.mutable_exact()->Add(v, v + n); };
    add(p.position.data(), 3);
    add(p.orientation.coeffs().data(), 4);
    add(p.velocity.data(), 3);
    add(p.angular_velocity.data(), 3);
  }

  const CellFormat& format_;
  const Fates& fates_;
  const Tick tick_;
  CellKey key_;
  v1::Cell out_;
  IdColumn new_id_{out_.mutable_new_id()}, id_{out_.mutable_id()}, slept_{out_.mutable_slept()},
      woke_{out_.mutable_woke()}, gone_{out_.mutable_gone()};
  std::vector<const BodyPose*> whole_, changed_;
  BitWriter bits_;
  EncodedCell result_;
};

}  // namespace

EncodedCell EncodeCell(const CellState* base, const CellState* state, const CellFormat& format, const Fates& fates,
                       Tick tick) {
  return Encoder(format, fates, tick).Encode(base, state);
}

}  // namespace aureole
