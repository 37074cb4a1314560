#include "server/core/partition.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>

#include <absl/status/status.h>
#include <absl/strings/str_cat.h>

namespace aureole {
namespace {

constexpr double kInf = std::numeric_limits<double>::infinity();

absl::Status CheckEdges(std::span<const double> edges, const char* field) {
  for (size_t i = 0; i < edges.size(); ++i) {
    if (!std::isfinite(edges[i])) return absl::InvalidArgumentError(absl::StrCat(field, "[", i, "]: must be finite"));
    if (i > 0 && edges[i] <= edges[i - 1]) {
      return absl::InvalidArgumentError(absl::StrCat(field, "[", i, "]: must be greater than the edge before it (",
                                                     edges[i - 1], "), is ", edges[i]));
    }
  }
  return absl::OkStatus();
}

// Edge i of the cells, with infinite outer edges.
double At(std::span<const double> edges, int i) {
  if (i < 0) return -kInf;
  return i < static_cast<int>(edges.size()) ? edges[i] : kInf;
}

// A finite point inside [a, b), whatever of the two is infinite.
double Inside(double a, double b) {
  if (std::isinf(a) && std::isinf(b)) return 0;
  if (std::isinf(a)) return b - 1;
  if (std::isinf(b)) return a + 1;
  return a + (b - a) / 2;
}

std::string Show(const Rect& r) {
  return absl::StrCat("[", r.min_x, ", ", r.max_x, ") x [", r.min_z, ", ", r.max_z, ")");
}

}  // namespace

Layout::Layout(std::vector<Rect> regions) : regions_(std::move(regions)), ranks_(regions_.size()) {
  for (size_t i = 0; i < ranks_.size(); ++i) ranks_[i] = static_cast<int>(i);
}

absl::StatusOr<Layout> Layout::Columns(std::span<const double> edges) {
  if (absl::Status s = CheckEdges(edges, "edges"); !s.ok()) return s;
  std::vector<Rect> regions;
  for (int i = -1; i < static_cast<int>(edges.size()); ++i) {
    regions.push_back({At(edges, i), At(edges, i + 1), -kInf, kInf});
  }
  return Layout(std::move(regions));
}

absl::StatusOr<Layout> Layout::Grid(std::span<const double> x_edges, std::span<const double> z_edges) {
  if (absl::Status s = CheckEdges(x_edges, "x_edges"); !s.ok()) return s;
  if (absl::Status s = CheckEdges(z_edges, "z_edges"); !s.ok()) return s;
  std::vector<Rect> regions;
  for (int j = -1; j < static_cast<int>(z_edges.size()); ++j) {
    for (int i = -1; i < static_cast<int>(x_edges.size()); ++i) {
      regions.push_back({At(x_edges, i), At(x_edges, i + 1), At(z_edges, j), At(z_edges, j + 1)});
    }
  }
  return Layout(std::move(regions));
}

absl::StatusOr<Layout> Layout::Bricks(std::span<const double> x_edges, std::span<const double> z_edges) {
  if (absl::Status s = CheckEdges(x_edges, "x_edges"); !s.ok()) return s;
  if (absl::Status s = CheckEdges(z_edges, "z_edges"); !s.ok()) return s;
  if (x_edges.empty() || z_edges.empty()) {
    return absl::InvalidArgumentError("x_edges, z_edges: bricks need at least one edge each; use columns instead");
  }
  std::vector<Rect> regions;
  const int n = static_cast<int>(x_edges.size());
  for (int j = -1; j < static_cast<int>(z_edges.size()); ++j) {
    std::vector<double> xs(x_edges.begin(), x_edges.end());
    if ((j + 1) % 2 == 1) {
      // Half a cell to the right; the last edge by half of the cell before it.
      for (int i = 0; i < n; ++i) {
        const double cell = i + 1 < n ? x_edges[i + 1] - x_edges[i] : (n > 1 ? x_edges[i] - x_edges[i - 1] : 2.0);
        xs[i] += cell / 2;
      }
    }
    for (int i = -1; i < n; ++i) regions.push_back({At(xs, i), At(xs, i + 1), At(z_edges, j), At(z_edges, j + 1)});
  }
  return Layout(std::move(regions));
}

absl::StatusOr<Layout> Layout::Rectangles(std::vector<Rect> regions) { return Tiling(std::move(regions), false); }

absl::StatusOr<Layout> Layout::WithRanks(std::vector<Rect> regions, std::vector<int> ranks) {
  absl::StatusOr<Layout> layout = Tiling(std::move(regions), true);
  if (!layout.ok()) return layout;
  if (absl::Status s = layout->SetRanks(std::move(ranks)); !s.ok()) return s;
  return layout;
}

absl::StatusOr<Layout> Layout::Tiling(std::vector<Rect> regions, bool some_without_area) {
  if (regions.empty()) return absl::InvalidArgumentError("regions: must not be empty");
  std::set<double> xs{-kInf, kInf}, zs{-kInf, kInf};
  for (size_t i = 0; i < regions.size(); ++i) {
    const Rect& r = regions[i];
    if (some_without_area && r == Rect{}) continue;
    if (!r.HasArea()) {
      return absl::InvalidArgumentError(absl::StrCat("regions[", i, "]: is empty: ", Show(r)));
    }
    xs.insert({r.min_x, r.max_x});
    zs.insert({r.min_z, r.max_z});
  }
  // Between consecutive edges nothing changes: one point of each cell decides.
  for (auto x = xs.begin(); std::next(x) != xs.end(); ++x) {
    for (auto z = zs.begin(); std::next(z) != zs.end(); ++z) {
      const double px = Inside(*x, *std::next(x)), pz = Inside(*z, *std::next(z));
      int found = -1;
      for (size_t i = 0; i < regions.size(); ++i) {
        if (!regions[i].Contains(px, pz)) continue;
        if (found >= 0) {
          return absl::InvalidArgumentError(
              absl::StrCat("regions[", i, "]: overlaps regions[", found, "] at (x ", px, ", z ", pz, ")"));
        }
        found = static_cast<int>(i);
      }
      if (found < 0) {
        return absl::InvalidArgumentError(
            absl::StrCat("regions: none covers the point (x ", px, ", z ", pz, "); the regions must tile the plane"));
      }
    }
  }
  return Layout(std::move(regions));
}

absl::Status Layout::SetRanks(std::vector<int> ranks) {
  if (ranks.size() != regions_.size()) {
    return absl::InvalidArgumentError(
        absl::StrCat("ranks: must hold one rank per region (", regions_.size(), "), holds ", ranks.size()));
  }
  std::vector<bool> seen(ranks.size());
  for (size_t i = 0; i < ranks.size(); ++i) {
    if (ranks[i] < 0 || ranks[i] >= size() || seen[ranks[i]]) {
      return absl::InvalidArgumentError(
          absl::StrCat("ranks[", i, "]: must be a permutation of 0..", size() - 1, ", is ", ranks[i]));
    }
    seen[ranks[i]] = true;
  }
  ranks_ = std::move(ranks);
  return absl::OkStatus();
}

RegionId Layout::Home(double x, double z) const {
  for (RegionId r = 0; r < size(); ++r) {
    if (regions_[r].Contains(x, z)) return r;
  }
  // Only a point that is not finite is nowhere; it must have some home until it is refused.
  return static_cast<RegionId>(
      std::find_if(regions_.begin(), regions_.end(), [](const Rect& r) { return r.HasArea(); }) - regions_.begin());
}

int Layout::ChainNumber(double reach) const {
  // The deepest overlap of closed rectangles, each grown by `reach`, is found at the left edge of one of them and the
  // lower edge of one.
  std::set<double> xs, zs;
  for (const Rect& r : regions_) {
    if (!r.HasArea()) continue;
    xs.insert(std::isinf(r.min_x) ? -1e12 : r.min_x - reach);
    zs.insert(std::isinf(r.min_z) ? -1e12 : r.min_z - reach);
  }
  int deepest = 1;
  for (double x : xs) {
    for (double z : zs) {
      int depth = 0;
      for (const Rect& r : regions_) {
        depth +=
            r.HasArea() && x >= r.min_x - reach && x <= r.max_x + reach && z >= r.min_z - reach && z <= r.max_z + reach;
      }
      deepest = std::max(deepest, depth);
    }
  }
  return deepest;
}

double Layout::NarrowestExtent() const {
  double narrowest = kInf;
  for (const Rect& r : regions_) {
    if (r.HasArea()) narrowest = std::min({narrowest, r.max_x - r.min_x, r.max_z - r.min_z});
  }
  return narrowest;
}

}  // namespace aureole
