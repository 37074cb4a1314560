// Which layout an operator's wish means: whole cells for regions, so that as little as possible changes hands.
#pragma once

#include <vector>

#include <absl/status/statusor.h>

#include "server/core/scene.h"
#include "server/core/world.h"

namespace aureole {

// Around the places where the world's bodies begin, injected ones included; at least 10 m wide each way.
Rect WhereBodiesBegin(const World& world);

// Cells of equal size, columns along x times rows along z, over the places where the world's bodies begin; the outer
// ones reach on to infinity. InvalidArgument: fewer than one, or more than limits::kMaxRegions.
absl::StatusOr<std::vector<Rect>> EqualCells(const World& world, int columns, int rows);

// By region, as in LayoutChange: each cell goes to the region that has most of it now, as far as that is free; the
// others to the lowest regions without area. `busy`: regions that no cell may go to, such as one that is leaving.
std::vector<Rect> AssignCells(const LayoutChange& now, const std::vector<Rect>& cells,
                              const std::vector<RegionId>& busy = {});

// The same layout, but the lowest region that is free has the region's area: it has none, is no member, and is not in
// `busy`. InvalidArgument: no such region; ResourceExhausted: none is free.
struct StandIn {
  RegionId region = kNoRegion;
  std::vector<Rect> regions;
};
absl::StatusOr<StandIn> WithStandIn(const LayoutChange& now, RegionId region, const std::vector<RegionId>& busy = {});

// The same layout, but a neighbour has the region's area too. InvalidArgument: no such region, or it is the last one;
// FailedPrecondition: no other shares a whole side with it.
absl::StatusOr<std::vector<Rect>> WithoutArea(const LayoutChange& now, RegionId region);

}  // namespace aureole
