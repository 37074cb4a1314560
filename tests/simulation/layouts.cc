#include "tests/simulation/layouts.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace aureole::sim {
namespace {

constexpr double kInf = std::numeric_limits<double>::infinity();
constexpr double kWide = 8;  // m: scenes happen within this of the origin

std::vector<RegionId> WithArea(const LayoutChange& c) {
  std::vector<RegionId> out;
  for (size_t i = 0; i < c.regions.size(); ++i) {
    if (c.regions[i].HasArea()) out.push_back(static_cast<RegionId>(i));
  }
  return out;
}

// The next epoch, and nothing changed but for the ranks.
LayoutChange After(const Division::State& now) {
  LayoutChange c;
  c.epoch = now.epoch + 1;
  for (RegionId r = 0; r < now.layout.size(); ++r) {
    c.regions.push_back(now.layout.rect(r));
    c.ranks.push_back(now.layout.rank(r));
  }
  c.members = now.members;
  return c;
}

void Shuffle(std::vector<int>* list, Random& rng) {
  for (int i = static_cast<int>(list->size()) - 1; i > 0; --i) std::swap((*list)[i], (*list)[rng.Below(i + 1)]);
}

// A place to cut the rectangle, or NaN when it is too narrow.
double Cut(double low, double high, Random& rng) {
  const double a = std::max(low, -kWide), b = std::min(high, kWide);
  return b - a > 0.5 ? rng.In(a + 0.1, b - 0.1) : std::numeric_limits<double>::quiet_NaN();
}

bool Split(const Rect& whole, Random& rng, Rect* first, Rect* second) {
  *first = *second = whole;
  const double x = Cut(whole.min_x, whole.max_x, rng), z = Cut(whole.min_z, whole.max_z, rng);
  const bool along_x = std::isnan(z) || (!std::isnan(x) && rng.Chance(0.5));
  if (along_x) {
    first->max_x = second->min_x = x;
  } else {
    first->max_z = second->min_z = z;
  }
  return !std::isnan(along_x ? x : z);
}

// The whole plane anew between these regions.
void Redivide(std::vector<RegionId> ids, LayoutChange* c, Random& rng) {
  Shuffle(&ids, rng);
  for (Rect& r : c->regions) r = {};
  c->regions[ids[0]] = {-kInf, kInf, -kInf, kInf};
  for (size_t i = 1; i < ids.size(); ++i) {
    for (bool done = false; !done;) {
      Rect& from = c->regions[ids[rng.Below(static_cast<int>(i))]];
      Rect a, b;
      done = Split(from, rng, &a, &b);
      if (!done) continue;
      from = a;
      c->regions[ids[i]] = b;
    }
  }
  Shuffle(&c->ranks, rng);
}

// Moves one edge, of all regions that have it.
bool MoveEdge(LayoutChange* c, Random& rng) {
  const std::vector<RegionId> ids = WithArea(*c);
  const bool along_x = rng.Chance(0.5);
  const Rect& r = c->regions[ids[rng.Below(static_cast<int>(ids.size()))]];
  const double edge = along_x ? r.min_x : r.min_z, to = edge + rng.In(-2, 2);
  if (std::isinf(edge)) return false;
  for (RegionId id : ids) {
    Rect& moved = c->regions[id];
    for (double* e : {along_x ? &moved.min_x : &moved.min_z, along_x ? &moved.max_x : &moved.max_z}) {
      if (*e == edge) *e = to;
    }
  }
  return LayoutOf(*c).ok();
}

// Gives the area of a region to one that shares a whole side with it.
bool Merge(RegionId id, LayoutChange* c) {
  const Rect gone = c->regions[id];
  c->regions[id] = {};
  for (RegionId r : WithArea(*c)) {
    Rect& to = c->regions[r];
    const Rect before = to;
    const bool beside = to.min_z == gone.min_z && to.max_z == gone.max_z;
    const bool behind = to.min_x == gone.min_x && to.max_x == gone.max_x;
    if (beside) to = {std::min(to.min_x, gone.min_x), std::max(to.max_x, gone.max_x), to.min_z, to.max_z};
    if (behind) to = {to.min_x, to.max_x, std::min(to.min_z, gone.min_z), std::max(to.max_z, gone.max_z)};
    if ((beside || behind) && LayoutOf(*c).ok()) return true;
    to = before;
  }
  return false;
}

}  // namespace

LayoutChange MoveBorders(const Division::State& now, Random& rng) {
  LayoutChange c = After(now);
  const LayoutChange before = c;
  if (rng.Chance(0.6) && MoveEdge(&c, rng)) return c;
  c = before;
  Redivide(WithArea(c), &c, rng);
  return c;
}

LayoutChange AddRegion(const Division::State& now, RegionId id, Random& rng) {
  LayoutChange c = After(now);
  while (static_cast<RegionId>(c.regions.size()) <= id) {
    c.ranks.push_back(static_cast<int>(c.regions.size()));
    c.regions.emplace_back();
  }
  c.members.insert(std::lower_bound(c.members.begin(), c.members.end(), id), id);
  std::vector<RegionId> ids = WithArea(c);
  Rect& from = c.regions[ids[rng.Below(static_cast<int>(ids.size()))]];
  Rect a, b;
  if (rng.Chance(0.5) && Split(from, rng, &a, &b)) {
    from = a;
    c.regions[id] = b;
    return c;
  }
  ids.push_back(id);
  Redivide(ids, &c, rng);
  return c;
}

LayoutChange TakeArea(const Division::State& now, RegionId id, Random& rng) {
  LayoutChange c = After(now);
  const LayoutChange before = c;
  if (rng.Chance(0.5) && Merge(id, &c)) return c;
  c = before;
  std::vector<RegionId> ids = WithArea(c);
  std::erase(ids, id);
  Redivide(ids, &c, rng);
  return c;
}

LayoutChange DropRegion(const Division::State& now, RegionId id) {
  LayoutChange c = After(now);
  std::erase(c.members, id);
  return c;
}

}  // namespace aureole::sim
