// Basic quantities of the core. SI units; one global right-handed frame, y up, double precision.
#pragma once

#include <algorithm>
#include <cstdint>

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace aureole {

// Identity of a body for its whole life; never 0, never reused. Orders everything (EXACT.md, recipe).
using BodyId = uint64_t;
using JointId = uint64_t;

// Tick n is simulated time n * tick length. State n is the state after tick n was stepped; state 0 is the initial one.
using Tick = int64_t;

// Index of a region in its layout, 0..n-1.
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

}  // namespace aureole
