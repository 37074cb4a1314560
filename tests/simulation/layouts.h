// Random changes of a running world's layout, as a control plane may ask for them.
#pragma once

#include "server/core/division.h"
#include "tests/simulation/random.h"

namespace aureole::sim {

// Each is the next change after the layout with this state.

// Borders move, a little or everywhere. No region gets or loses an area.
LayoutChange MoveBorders(const Division::State& now, Random& rng);
// Region `id`, no member now, becomes one, with an area.
LayoutChange AddRegion(const Division::State& now, RegionId id, Random& rng);
// The others take the area of region `id`, which stays a member. Precondition: another has an area.
LayoutChange TakeArea(const Division::State& now, RegionId id, Random& rng);
// Region `id` is no member any more.
LayoutChange DropRegion(const Division::State& now, RegionId id);

}  // namespace aureole::sim
