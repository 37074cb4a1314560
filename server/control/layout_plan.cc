#include "server/control/layout_plan.h"

#include <algorithm>
#include <limits>
#include <tuple>

#include <absl/strings/str_cat.h>

#include "server/core/limits.h"
#include "server/core/partition.h"

namespace aureole {
namespace {

constexpr double kInf = std::numeric_limits<double>::infinity();
constexpr double kFar = 1e5;    // m: what lies beyond weighs nothing
constexpr double kNarrow = 10;  // m: a world is at least so wide

// The edges of `count` equal parts between these, infinity first and last.
std::vector<double> Edges(double low, double high, int count) {
  std::vector<double> out = {-kInf};
  for (int i = 1; i < count; ++i) out.push_back(low + (high - low) * i / count);
  out.push_back(kInf);
  return out;
}

double Overlap(const Rect& a, const Rect& b) {
  const auto along = [](double low, double high, double other_low, double other_high) {
    return std::min({high, other_high, kFar}) - std::max({low, other_low, -kFar});
  };
  const double x = along(a.min_x, a.max_x, b.min_x, b.max_x), z = along(a.min_z, a.max_z, b.min_z, b.max_z);
  return x > 0 && z > 0 ? x * z : 0;
}

absl::Status CheckArea(const LayoutChange& now, RegionId region) {
  const bool known = region >= 0 && static_cast<size_t>(region) < now.regions.size();
  if (known && now.regions[static_cast<size_t>(region)].HasArea()) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat("region: ", region, " has no area; ask for the layout first"));
}

// At least kNarrow apart.
void Widen(double* low, double* high) {
  const double middle = (*low + *high) / 2;
  *low = std::min(*low, middle - kNarrow / 2);
  *high = std::max(*high, middle + kNarrow / 2);
}

}  // namespace

Rect WhereBodiesBegin(const World& world) {
  Box all{Vec3::Constant(kInf), Vec3::Constant(-kInf)};
  const auto include = [&all](const Vec3& min, const Vec3& max) {
    all.min = all.min.cwiseMin(min);
    all.max = all.max.cwiseMax(max);
  };
  for (const BodySpec& body : world.bodies) include(body.position, body.position);
  for (const Injector& injector : world.injectors) {
    for (const Injector::Volume& volume : injector.volumes) include(volume.min, volume.max);
  }
  if (all.min.x() > all.max.x()) all = {};
  Rect out{all.min.x(), all.max.x(), all.min.z(), all.max.z()};
  Widen(&out.min_x, &out.max_x);
  Widen(&out.min_z, &out.max_z);
  return out;
}

absl::StatusOr<std::vector<Rect>> EqualCells(const World& world, int columns, int rows) {
  if (columns < 1 || rows < 1 || columns > limits::kMaxRegions || rows > limits::kMaxRegions ||
      columns * rows > limits::kMaxRegions) {
    return absl::InvalidArgumentError(
        absl::StrCat("columns: ", columns, " times ", rows, " rows must be 1 to ", limits::kMaxRegions, " regions"));
  }
  const Rect all = WhereBodiesBegin(world);
  const std::vector<double> x = Edges(all.min_x, all.max_x, columns), z = Edges(all.min_z, all.max_z, rows);
  std::vector<Rect> out;
  for (size_t row = 0; row + 1 < z.size(); ++row) {
    for (size_t column = 0; column + 1 < x.size(); ++column) {
      out.push_back({x[column], x[column + 1], z[row], z[row + 1]});
    }
  }
  return out;
}

std::vector<Rect> AssignCells(const LayoutChange& now, const std::vector<Rect>& cells,
                              const std::vector<RegionId>& busy) {
  std::vector<std::tuple<double, size_t, size_t>> claims;  // less is better; cell, region
  for (size_t c = 0; c < cells.size(); ++c) {
    for (size_t r = 0; r < now.regions.size(); ++r) {
      const double common = Overlap(cells[c], now.regions[r]);
      if (common > 0) claims.emplace_back(-common, c, r);
    }
  }
  std::sort(claims.begin(), claims.end());
  std::vector<Rect> out(now.regions.size());
  std::vector<bool> given(cells.size());
  for (const auto& [less, c, r] : claims) {
    if (given[c] || out[r].HasArea()) continue;
    out[r] = cells[c];
    given[c] = true;
  }
  for (size_t c = 0; c < cells.size(); ++c) {
    for (size_t r = 0; !given[c]; ++r) {
      if (r == out.size()) out.emplace_back();
      const bool free = std::find(busy.begin(), busy.end(), static_cast<RegionId>(r)) == busy.end();
      if (out[r].HasArea() || !free) continue;
      out[r] = cells[c];
      given[c] = true;
    }
  }
  return out;
}

absl::StatusOr<StandIn> WithStandIn(const LayoutChange& now, RegionId region, const std::vector<RegionId>& busy) {
  if (absl::Status s = CheckArea(now, region); !s.ok()) return s;
  const auto contains = [](const std::vector<RegionId>& list, RegionId r) {
    return std::find(list.begin(), list.end(), r) != list.end();
  };
  StandIn out{0, now.regions};
  const auto size = static_cast<RegionId>(out.regions.size());
  while (contains(now.members, out.region) || contains(busy, out.region) ||
         (out.region < size && out.regions[static_cast<size_t>(out.region)].HasArea())) {
    ++out.region;
  }
  if (out.region >= limits::kMaxRegions) {
    return absl::ResourceExhaustedError(absl::StrCat("all ", limits::kMaxRegions, " regions of a world are in use"));
  }
  out.regions.resize(std::max(out.regions.size(), static_cast<size_t>(out.region) + 1));
  std::swap(out.regions[static_cast<size_t>(region)], out.regions[static_cast<size_t>(out.region)]);
  return out;
}

absl::StatusOr<std::vector<Rect>> WithoutArea(const LayoutChange& now, RegionId region) {
  if (absl::Status s = CheckArea(now, region); !s.ok()) return s;
  const Rect gone = now.regions[static_cast<size_t>(region)];
  std::vector<Rect> out = now.regions;
  out[static_cast<size_t>(region)] = {};
  bool last = true;
  for (Rect& to : out) {
    if (!to.HasArea()) continue;
    last = false;
    const Rect before = to;
    const bool beside = to.min_z == gone.min_z && to.max_z == gone.max_z;
    const bool behind = to.min_x == gone.min_x && to.max_x == gone.max_x;
    if (!beside && !behind) continue;
    to = {std::min(to.min_x, gone.min_x), std::max(to.max_x, gone.max_x), std::min(to.min_z, gone.min_z),
          std::max(to.max_z, gone.max_z)};
    if (Layout::WithRanks(out, now.ranks).ok()) return out;
    to = before;
  }
  if (last) return absl::InvalidArgumentError(absl::StrCat("region: ", region, " is the last one that has an area"));
  return absl::FailedPreconditionError(absl::StrCat("region: no other shares a whole side with region ", region,
                                                    "; resize the layout to cells without it instead"));
}

}  // namespace aureole
