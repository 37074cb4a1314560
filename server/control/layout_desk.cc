#include "server/control/layout_desk.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "server/control/balanced_cells.h"
#include "server/control/layout_change.h"
#include "server/control/layout_plan.h"
#include "server/core/limits.h"
#include "server/core/partition.h"

namespace aureole {
namespace {

bool InColumns(const Layout& layout) {
  for (RegionId r = 0; r < layout.size(); ++r) {
    if (std::isfinite(layout.rect(r).min_z) || std::isfinite(layout.rect(r).max_z)) return false;
  }
  return true;
}

}  // namespace

LayoutDesk::LayoutDesk(const World& world) : world_(world) { state_.now = FirstLayout(world); }

absl::Status LayoutDesk::Resize(int columns, int rows) {
  return Want([&](const LayoutChange& now, const State& state) -> absl::StatusOr<std::vector<Rect>> {
    absl::StatusOr<std::vector<Rect>> cells = EqualCells(world_, columns, rows);
    if (!cells.ok()) return cells;
    return AssignCells(now, *cells, state.leaving);
  });
}

absl::Status LayoutDesk::ResizeTo(int regions, const std::vector<double>& weights) {
  const State before = state();
  const std::vector<Rect>& homes = before.wanted.empty() ? before.now.regions : before.wanted;
  if (std::count_if(homes.begin(), homes.end(), [](const Rect& r) { return r.HasArea(); }) == regions) {
    return absl::OkStatus();
  }
  const bool columns = InColumns(world_.layout);
  int rows = 1;
  for (int n = 2; !columns && n * n <= regions; ++n) rows = regions % n == 0 ? n : rows;
  if (weights.empty() || regions < 1 || regions > limits::kMaxRegions) return Resize(regions / rows, rows);
  return Want([&](const LayoutChange& now, const State& state) -> absl::StatusOr<std::vector<Rect>> {
    return AssignCells(now, BalancedCells(world_, state.now, weights, regions, columns), state.leaving);
  });
}

absl::Status LayoutDesk::Drain(RegionId region) {
  return Want([&](const LayoutChange& now, const State&) { return WithoutArea(now, region); });
}

absl::Status LayoutDesk::Want(const Make& make) {
  if (world_.exchange.k != 0) {
    return absl::FailedPreconditionError(
        "the layout of this world cannot change while it runs, because its exchange has a delay; use the synchronous "
        "exchange");
  }
  const std::lock_guard lock(mutex_);
  LayoutChange base = state_.now;
  if (!state_.wanted.empty()) base.regions = state_.wanted;
  while (base.ranks.size() < base.regions.size()) base.ranks.push_back(static_cast<int>(base.ranks.size()));
  absl::StatusOr<std::vector<Rect>> wanted = make(base, state_);
  if (!wanted.ok()) return wanted.status();
  std::vector<int> ranks;
  for (size_t i = 0; i < wanted->size(); ++i) ranks.push_back(static_cast<int>(i));
  if (absl::Status s = Layout::WithRanks(*wanted, ranks).status(); !s.ok()) return s;
  state_.wanted = *std::move(wanted);
  state_.changing = true;
  return absl::OkStatus();
}

LayoutDesk::State LayoutDesk::state() const {
  const std::lock_guard lock(mutex_);
  return state_;
}

std::vector<Rect> LayoutDesk::wanted() const {
  const std::lock_guard lock(mutex_);
  return state_.wanted;
}

// What is wanted may have become another meanwhile.
void LayoutDesk::Publish(State state) {
  const std::lock_guard lock(mutex_);
  if (state.wanted != state_.wanted) {
    state.wanted = state_.wanted;
    state.changing = true;
  }
  state_ = std::move(state);
}

}  // namespace aureole
