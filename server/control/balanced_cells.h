// A layout of which every region has about the same load, as far as that is known: by region, not by place.
#pragma once

#include <vector>

#include "server/core/scene.h"
#include "server/core/world.h"

namespace aureole {

// `count` cells that tile the plane: the plane is cut in two, and each part again, so that both sides have a weight in
// proportion to the cells that they become. That of each region (by region as in `now`, >= 0) is taken to be spread
// evenly over its rectangle, as far as bodies begin there; a tenth of all over the whole of that. Cuts are along x
// (`columns`), or across the longer side; cells are at least 2 m wide unless there is less room. Precondition: count >
// 0.
std::vector<Rect> BalancedCells(const World& world, const LayoutChange& now, const std::vector<double>& weights,
                                int count, bool columns);

}  // namespace aureole
