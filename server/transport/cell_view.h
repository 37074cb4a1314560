// Which cells a client wants to see, and how often (simulation.proto: View, LevelOfDetail).
#pragma once

#include <array>
#include <optional>
#include <vector>

#include "aureole/v1/simulation.pb.h"
#include "server/transport/cell_state.h"
#include "server/transport/spec_check.h"

namespace aureole {

class CellView {
 public:
  // Everything.
  CellView() = default;
  // A mistake is told to `check`, with fields below `path`.
  CellView(const Path& path, const v1::View& view, SpecCheck* check);

  bool everything() const { return planes_.empty(); }
  bool Selects(const CellKey& cell) const;
  // The selected cells, ascending; nothing when they are more than `most`.
  std::optional<std::vector<CellKey>> Cells(size_t most) const;

 private:
  struct Plane {  // points x with normal . x >= offset
    Vec3 normal;
    double offset = 0;
  };
  void AddRect(double min_x, double max_x, double min_z, double max_z);
  void ReadFrustum(const Path& path, const v1::View& view, SpecCheck* check);
  void FindBounds();

  // Convex; a sphere has a round test beside.
  std::vector<Plane> planes_;
  double min_y_ = 0, max_y_ = 0;
  bool round_ = false;
  Vec3 centre_ = Vec3::Zero();
  double radius_ = 0;
  // Of the selection in x and z; inverted when it is empty.
  double min_x_ = 0, max_x_ = 0, min_z_ = 0, max_z_ = 0;
};

class DetailLevels {
 public:
  // Every cell in every frame.
  DetailLevels() = default;
  DetailLevels(const Path& path, const v1::LevelOfDetail& detail, SpecCheck* check);
  bool full() const { return full_within_ == 0; }
  // The cell is told in every so-many-th frame: 1, 2, 4 or 8.
  int Every(const CellKey& cell) const;

 private:
  Vec3 eye_ = Vec3::Zero();
  double full_within_ = 0;
};

}  // namespace aureole
