#include "server/control/layout_change.h"

#include <algorithm>
#include <numeric>

#include "server/core/division.h"

namespace aureole {
namespace {

using Kind = LayoutStep::Kind;

bool Contains(const std::vector<RegionId>& list, RegionId r) { return std::binary_search(list.begin(), list.end(), r); }

Rect RectOf(const std::vector<Rect>& regions, RegionId r) {
  return static_cast<size_t>(r) < regions.size() ? regions[static_cast<size_t>(r)] : Rect{};
}

const RegionSeen& Seen(const LayoutObserved& o, RegionId r) {
  static const RegionSeen kNothing;
  return static_cast<size_t>(r) < o.regions.size() ? o.regions[static_cast<size_t>(r)] : kNothing;
}

LayoutStep Await(const LayoutObserved& o) {
  const LayoutChange& change = *o.proposed;
  if (o.withdrawn) return {Kind::kDrop};
  // All adopt a layout at the same tick, so one who says that it is in force speaks for all.
  const bool in_force = std::any_of(o.now.members.begin(), o.now.members.end(),
                                    [&](RegionId r) { return Seen(o, r).epoch >= change.epoch; });
  if (in_force || o.accepted) return {Kind::kAdopt};
  if (o.refused) return {Kind::kDrop};
  if (o.offered) return {};
  for (RegionId r : change.members) {
    const bool joins = !Contains(o.now.members, r);
    if (joins && !(Seen(o, r).ready && Seen(o, r).may_join)) return {};
  }
  for (RegionId r : o.now.members) {
    if (Seen(o, r).ready && Contains(change.members, r)) return {Kind::kOffer, {}, r};
  }
  return {};
}

// `now`, with room for as many regions as `count`.
LayoutChange After(const LayoutChange& now, size_t count) {
  LayoutChange out = now;
  ++out.epoch;
  while (out.regions.size() < count) {
    out.ranks.push_back(static_cast<int>(out.regions.size()));
    out.regions.emplace_back();
  }
  return out;
}

LayoutStep Propose(const LayoutObserved& o) {
  LayoutChange change = After(o.now, o.wanted.size());
  bool differs = false;
  for (size_t i = 0; i < change.regions.size() && !o.wanted.empty(); ++i) {
    const auto r = static_cast<RegionId>(i);
    const Rect rect = RectOf(o.wanted, r);
    differs |= rect != change.regions[i];
    change.regions[i] = rect;
    if (!rect.HasArea() || Contains(change.members, r)) continue;
    if (!Seen(o, r).free) return {};
    change.members.insert(std::lower_bound(change.members.begin(), change.members.end(), r), r);
  }
  if (differs) return {Kind::kPropose, change};
  std::erase_if(change.members, [&](RegionId r) {
    const RegionSeen& seen = Seen(o, r);
    return !RectOf(change.regions, r).HasArea() && seen.epoch == o.now.epoch && seen.bodies == 0;
  });
  if (change.members != o.now.members) return {Kind::kPropose, change};
  return {};
}

}  // namespace

LayoutStep NextLayoutStep(const LayoutObserved& observed) {
  return observed.proposed.has_value() ? Await(observed) : Propose(observed);
}

LayoutChange FirstLayout(const World& world) {
  LayoutChange out;
  out.epoch = kFirstLayoutEpoch;
  for (RegionId r = 0; r < world.layout.size(); ++r) {
    out.regions.push_back(world.layout.rect(r));
    out.ranks.push_back(world.layout.rank(r));
    out.members.push_back(r);
  }
  return out;
}

}  // namespace aureole
