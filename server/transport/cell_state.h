// The bodies of one cell of a region at one tick, as streams tell them. A cell is a square of the x,z plane; a body is
// in the cell of its centre of mass. Cells are what views select and what is encoded once for all who see it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <vector>

#include "server/transport/quantise.h"

namespace aureole {

inline constexpr double kCellSize = 32;  // m

struct CellKey {
  int32_t x = 0, z = 0;  // the cell holds x in [32 x, 32 x + 32), likewise z
  friend bool operator==(const CellKey&, const CellKey&) = default;
  friend auto operator<=>(const CellKey&, const CellKey&) = default;
  template <class H>
  friend H AbslHashValue(H h, const CellKey& c) {
    return H::combine(std::move(h), c.x, c.z);
  }
};

// Steps of kFineQuanta from the origin to any cell fit 32 bits: 1,048,576 m. What is further out is in the outermost.
inline constexpr int32_t kLastCell = 32767;
inline CellKey CellOf(const Vec3& position) {
  const auto index = [](double metres) {
    return static_cast<int32_t>(std::clamp(std::floor(metres / kCellSize), -kLastCell - 1.0, double{kLastCell}));
  };
  return {index(position.x()), index(position.z())};
}

enum class Precision : uint8_t { kFine = 0, kCoarse = 1, kExact = 2 };
enum class CellLayout : uint8_t { kColumns = 0, kBits = 1 };

// How a stream wants its cells. Exact ones are always columns.
struct CellFormat {
  Precision precision = Precision::kFine;
  bool velocities = false;
  CellLayout layout = CellLayout::kColumns;
  friend bool operator==(const CellFormat&, const CellFormat&) = default;
  friend auto operator<=>(const CellFormat&, const CellFormat&) = default;
};

struct CellBody {
  BodyId id = 0;
  Epoch epoch = 0;
  QuantisedPose pose;
};

// Immutable. One that has not changed stays the same object.
struct CellState {
  CellKey key;
  std::vector<CellBody> bodies;  // ascending ids
  std::vector<BodyPose> exact;   // precision kExact: of the same bodies
};

}  // namespace aureole
