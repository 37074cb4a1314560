// Poses as integers, for the streams of clients (proto/aureole/v1/simulation.proto: Precision).
#pragma once

#include <array>
#include <cstdint>

#include "server/core/engine.h"

namespace aureole {

// Steps of the integers. What is told differs from the truth by half a step per component.
struct Quanta {
  double position = 0;     // m
  double orientation = 0;  // of a component of the unit quaternion
  double velocity = 0;     // m/s and rad/s
};

// At most 0.43 mm and 0.049 degrees off: sqrt(3)/2 steps, and 2 sqrt(3) steps in radians, as shown in quantise.cc.
inline constexpr Quanta kFineQuanta{1.0 / 2048, 1.0 / 4096, 1.0 / 64};
// At most 7 mm and 0.39 degrees off.
inline constexpr Quanta kCoarseQuanta{1.0 / 128, 1.0 / 512, 1.0 / 8};

struct QuantisedPose {
  std::array<int32_t, 3> position{};
  // The three components that are not the largest, in the order x, y, z, w; the sign is that which makes the largest
  // positive.
  std::array<int32_t, 3> orientation{};
  std::array<int32_t, 6> velocity{};  // and the angular one; 0 when asleep
  uint8_t largest = 0;                // of x, y, z, w
  bool asleep = false;
  friend bool operator==(const QuantisedPose&, const QuantisedPose&) = default;
};

// `largest`: the component that was left out so far (3 for a new body); kept while it may be, so that the others change
// little from one state to the next.
QuantisedPose Quantise(const BodyPose& pose, const Quanta& quanta, uint8_t largest);

}  // namespace aureole
