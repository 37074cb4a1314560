// Why the error of an orientation is at most 2 sqrt(3) s for a step s: with the left-out component l >= 1/2, the others
// a, b, c are each off by at most s/2, together by sqrt(3)/2 s, and l, which follows from them, by at most
// (|a| + |b| + |c|) s / (2 l) <= 3/2 s, since |a| + |b| + |c| <= 3/2 where a^2 + b^2 + c^2 <= 3/4. The quaternion is
// then off by at most sqrt(3/4 + 9/4) s = sqrt(3) s, and the angle by twice that.
#include "server/transport/quantise.h"

#include <algorithm>
#include <cmath>

namespace aureole {
namespace {

constexpr double kLeastLargest = 0.5;  // the largest of four components is never below

int32_t Round(double value, double step) {
  const double steps = std::nearbyint(value / step);
  return static_cast<int32_t>(std::clamp(steps, -2147483647.0, 2147483647.0));
}

}  // namespace

QuantisedPose Quantise(const BodyPose& pose, const Quanta& quanta, uint8_t largest) {
  QuantisedPose out;
  const Eigen::Vector4d& q = pose.orientation.coeffs();
  if (std::abs(q[largest]) < kLeastLargest) {
    Eigen::Index index = 0;
    q.cwiseAbs().maxCoeff(&index);
    largest = static_cast<uint8_t>(index);
  }
  out.largest = largest;
  const double sign = q[largest] < 0 ? -1 : 1;
  for (int from = 0, to = 0; from < 4; ++from) {
    if (from != largest) out.orientation[to++] = Round(sign * q[from], quanta.orientation);
  }
  for (int i = 0; i < 3; ++i) out.position[i] = Round(pose.position[i], quanta.position);
  out.asleep = pose.asleep;
  if (pose.asleep) return out;
  for (int i = 0; i < 3; ++i) {
    out.velocity[i] = Round(pose.velocity[i], quanta.velocity);
    out.velocity[3 + i] = Round(pose.angular_velocity[i], quanta.velocity);
  }
  return out;
}

}  // namespace aureole
