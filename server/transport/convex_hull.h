// The convex hull of a few points: is it a body, how large is it, does it hold its centre of mass.
#pragma once

#include <vector>

#include "server/core/types.h"

namespace aureole {

struct HullMeasure {
  double volume = 0;  // m^3; 0 when the points lie in a plane
  double depth = 0;   // m; distance of the origin to the nearest face, negative outside
};

// Tries every triple of points as a face: O(n^4) time, for at most limits::kMaxHullPoints points.
HullMeasure MeasureHull(const std::vector<Vec3>& points);

}  // namespace aureole
