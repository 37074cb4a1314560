#include "server/control/balanced_cells.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "server/control/layout_plan.h"

namespace aureole {
namespace {

constexpr double kInf = std::numeric_limits<double>::infinity();
constexpr double kBase = 0.1;    // of all weight: everywhere alike
constexpr double kMargin = 5;    // m, beyond the outermost border: so that every region has some room
constexpr double kNarrow = 2;    // m
constexpr int kBisections = 50;  // as many as a double can tell apart

double Area(const Rect& r) { return (r.max_x - r.min_x) * (r.max_z - r.min_z); }

Rect Common(const Rect& a, const Rect& b) {
  const Rect out{std::max(a.min_x, b.min_x), std::min(a.max_x, b.max_x), std::max(a.min_z, b.min_z),
                 std::min(a.max_z, b.max_z)};
  return out.min_x < out.max_x && out.min_z < out.max_z ? out : Rect{0, 0, 0, 0};
}

class Cutter {
 public:
  Cutter(const Rect& room, const LayoutChange& now, const std::vector<double>& weights, bool columns)
      : columns_(columns) {
    double all = 0;
    for (size_t i = 0; i < now.regions.size() && i < weights.size(); ++i) {
      const Rect rect = Common(now.regions[i], room);
      if (!now.regions[i].HasArea() || !(Area(rect) > 0)) continue;
      parts_.push_back({rect, weights[i] / Area(rect)});
      all += weights[i];
    }
    parts_.push_back({room, (all > 0 ? all * kBase : 1) / Area(room)});
  }

  // `whole`: the same with its sides at infinity.
  void Cut(const Rect& rect, const Rect& whole, int count, std::vector<Rect>* out) const {
    if (count == 1) {
      out->push_back(whole);
      return;
    }
    const int first = count / 2;
    const bool along_x = columns_ || rect.max_x - rect.min_x >= rect.max_z - rect.min_z;
    const double at = Place(rect, along_x, first, count);
    Rect low = rect, high = rect, whole_low = whole, whole_high = whole;
    (along_x ? low.max_x : low.max_z) = (along_x ? high.min_x : high.min_z) = at;
    (along_x ? whole_low.max_x : whole_low.max_z) = (along_x ? whole_high.min_x : whole_high.min_z) = at;
    Cut(low, whole_low, first, out);
    Cut(high, whole_high, count - first, out);
  }

 private:
  struct Part {
    Rect rect;
    double density;  // weight/m^2
  };

  double Weight(const Rect& rect) const {
    double sum = 0;
    for (const Part& part : parts_) sum += part.density * Area(Common(part.rect, rect));
    return sum;
  }

  // Where the low side has the weight of `first` cells of `count`.
  double Place(const Rect& rect, bool along_x, int first, int count) const {
    const double low = along_x ? rect.min_x : rect.min_z, high = along_x ? rect.max_x : rect.max_z;
    const double share = static_cast<double>(first) / count, wanted = share * Weight(rect);
    double from = low, to = high;
    for (int i = 0; i < kBisections; ++i) {
      const double middle = (from + to) / 2;
      Rect side = rect;
      (along_x ? side.max_x : side.max_z) = middle;
      (Weight(side) < wanted ? from : to) = middle;
    }
    const double least = low + first * kNarrow, most = high - (count - first) * kNarrow;
    return least <= most ? std::clamp(to, least, most) : low + (high - low) * share;
  }

  const bool columns_;
  std::vector<Part> parts_;
};

}  // namespace

std::vector<Rect> BalancedCells(const World& world, const LayoutChange& now, const std::vector<double>& weights,
                                int count, bool columns) {
  Rect room = WhereBodiesBegin(world);
  for (const Rect& r : now.regions) {
    if (!r.HasArea()) continue;
    for (double x : {r.min_x, r.max_x}) {
      if (!std::isfinite(x)) continue;
      room.min_x = std::min(room.min_x, x - kMargin);
      room.max_x = std::max(room.max_x, x + kMargin);
    }
    for (double z : {r.min_z, r.max_z}) {
      if (!std::isfinite(z)) continue;
      room.min_z = std::min(room.min_z, z - kMargin);
      room.max_z = std::max(room.max_z, z + kMargin);
    }
  }
  std::vector<Rect> out;
  Cutter(room, now, weights, columns).Cut(room, {-kInf, kInf, -kInf, kInf}, count, &out);
  return out;
}

}  // namespace aureole
