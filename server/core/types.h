// Basic quantities of the core. SI units; one global right-handed frame, y up, double precision.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace aureole {

// Identity of a body for its whole life; never 0, never reused. Orders everything (EXACT.md, recipe).
using BodyId = uint64_t;
using JointId = uint64_t;

// Tick n is simulated time n * tick length. State n is the state after tick n was stepped; state 0 is the initial one.
using Tick = int64_t;

// Index of a region in its layout, 0..n-1. The same for as long as the region lives.
using RegionId = int32_t;
inline constexpr RegionId kNoRegion = -1;

// Counts the changes of ownership of one body; grows by one with each (invariant I3).
using Epoch = uint32_t;

using Vec3 = Eigen::Vector3d;
using Quat = Eigen::Quaterniond;

// Closed axis-aligned box.
struct Box {
  Vec3 min = Vec3::Zero();
  Vec3 max = Vec3::Zero();

  Box Inflated(double by) const { return {min.array() - by, max.array() + by}; }
  friend bool operator==(const Box& a, const Box& b) { return a.min == b.min && a.max == b.max; }
};

// Chebyshev distance of two boxes: the largest over the axes of (distance of centres - half extents). Zero or less iff
// they overlap or touch; the sign is exact in floating point, so it agrees with the engine's own overlap test
// (PROTOCOL.md, "Gap").
inline double Gap(const Box& a, const Box& b) {
  const double x = std::max(a.min.x() - b.max.x(), b.min.x() - a.max.x());
  const double y = std::max(a.min.y() - b.max.y(), b.min.y() - a.max.y());
  const double z = std::max(a.min.z() - b.max.z(), b.min.z() - a.max.z());
  return std::max(x, std::max(y, z));
}

inline bool Overlap(const Box& a, const Box& b) { return Gap(a, b) <= 0; }

// Half-open rectangle in x and z; y is unbounded; outer edges may be infinite. Rect{}, and only that, is no area: it
// holds no point, encloses nothing, and is infinitely far from everything.
struct Rect {
  double min_x = 0, max_x = 0, min_z = 0, max_z = 0;

  bool HasArea() const { return min_x < max_x && min_z < max_z; }
  bool Contains(double x, double z) const { return x >= min_x && x < max_x && z >= min_z && z < max_z; }
  // Whether the box lies wholly in the closed rectangle shrunk by `margin` on each finite side.
  bool Encloses(const Box& b, double margin) const {
    return HasArea() && b.min.x() >= min_x + margin && b.max.x() <= max_x - margin && b.min.z() >= min_z + margin &&
           b.max.z() <= max_z - margin;
  }
  // Chebyshev distance in x, z from the box to the closed rectangle; zero or less iff they meet.
  double Gap(const Box& b) const {
    if (!HasArea()) return std::numeric_limits<double>::infinity();
    return std::max(std::max(min_x - b.max.x(), b.min.x() - max_x), std::max(min_z - b.max.z(), b.min.z() - max_z));
  }
  friend bool operator==(const Rect&, const Rect&) = default;
};

}  // namespace aureole
