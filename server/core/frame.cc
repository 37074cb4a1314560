#include "server/core/frame.h"

#include <cmath>
#include <limits>

namespace aureole {
namespace {

float Down(double v) {
  const float f = static_cast<float>(v);
  return static_cast<double>(f) <= v ? f : std::nextafterf(f, -std::numeric_limits<float>::infinity());
}
float Up(double v) {
  const float f = static_cast<float>(v);
  return static_cast<double>(f) >= v ? f : std::nextafterf(f, std::numeric_limits<float>::infinity());
}

}  // namespace

WireBox RoundOutward(const Box& box) {
  WireBox w;
  for (int i = 0; i < 3; ++i) {
    w.min[i] = Down(box.min[i]);
    w.max[i] = Up(box.max[i]);
  }
  return w;
}

Box Widen(const WireBox& box) {
  return {Vec3(box.min[0], box.min[1], box.min[2]), Vec3(box.max[0], box.max[1], box.max[2])};
}

}  // namespace aureole
