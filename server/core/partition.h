// How a world is cut into regions.
#pragma once

#include <span>
#include <string>
#include <vector>

#include <absl/status/statusor.h>

#include "server/core/engine.h"
#include "server/core/types.h"

namespace aureole {

// The home rectangles of all regions and their ranks. Every point of the x,z plane has exactly one home (P26). The
// lower rank number is the better rank: it attracts, the others push (P27). A region without area is no point's home.
class Layout {
 public:
  // Columns along x: finite edges at `edges` (ascending), so edges.size() + 1 regions.
  static absl::StatusOr<Layout> Columns(std::span<const double> edges);
  // Rows x columns of cells; edges ascending in x and in z. Region index = row * columns + column.
  static absl::StatusOr<Layout> Grid(std::span<const double> x_edges, std::span<const double> z_edges);
  // Rows along z whose inner x edges are shifted by half a cell in every second row, so that at most three regions
  // meet. `x_edges` has at least one edge; `z_edges` at least one.
  static absl::StatusOr<Layout> Bricks(std::span<const double> x_edges, std::span<const double> z_edges);
  // Any rectangles that tile the plane. InvalidArgument names two that overlap, or a point that none covers.
  static absl::StatusOr<Layout> Rectangles(std::vector<Rect> regions);

  // The same, but a region may have no area (Rect{}), and with ranks as SetRanks takes them.
  static absl::StatusOr<Layout> WithRanks(std::vector<Rect> regions, std::vector<int> ranks);

  // Replaces the ranks (default: rank i = region i). InvalidArgument unless a permutation of 0..n-1.
  absl::Status SetRanks(std::vector<int> ranks);

  int size() const { return static_cast<int>(regions_.size()); }
  const Rect& rect(RegionId r) const { return regions_[r]; }
  int rank(RegionId r) const { return ranks_[r]; }
  bool has_area(RegionId r) const { return rect(r).HasArea(); }

  // The region whose half-open rectangle holds the point. Linear in the regions.
  RegionId Home(double x, double z) const;
  RegionId Home(const Vec3& p) const { return Home(p.x(), p.z()); }

  // m: the largest number of regions whose bodies can chain within one horizon (PROTOCOL.md section 1): the most
  // regions that come within `reach` metres of one point. 1 for a single region.
  int ChainNumber(double reach) const;
  // The smallest finite extent of any region; infinite when there is none.
  double NarrowestExtent() const;

  friend bool operator==(const Layout&, const Layout&) = default;

  template <class Archive>
  void Visit(Archive& a) {
    a(regions_, ranks_);
  }

 private:
  explicit Layout(std::vector<Rect> regions);
  static absl::StatusOr<Layout> Tiling(std::vector<Rect> regions, bool some_without_area);
  std::vector<Rect> regions_;
  std::vector<int> ranks_;
};

}  // namespace aureole
