#include "server/core/frame.h"

#include <limits>

#include <gtest/gtest.h>

namespace aureole {
namespace {

TEST(WireBox, ContainsTheBoxItWasMadeFrom) {
  for (double x : {0.0, 0.1, 1.0 / 3, 1234.5678, 16777217.0, 1e-60}) {
    for (double sign : {-1.0, 1.0}) {
      const Box box{Vec3::Constant(sign * x), Vec3::Constant(sign * x)};
      const Box wire = Widen(RoundOutward(box));
      for (int i = 0; i < 3; ++i) {
        EXPECT_LE(wire.min[i], box.min[i]);
        EXPECT_GE(wire.max[i], box.max[i]);
      }
    }
  }
}

TEST(WireBox, IsTheBoxWhereSinglePrecisionHoldsIt) {
  const Box box{Vec3(-1.5, 0, 1024.25), Vec3(-0.5, 0, 2048)};
  EXPECT_EQ(Widen(RoundOutward(box)), box);
}

TEST(WireBox, IsWidenedByNoMoreThanTheLastBit) {
  const Box wire = Widen(RoundOutward({Vec3::Constant(0.1), Vec3::Constant(0.1)}));
  EXPECT_LE(wire.max.x() - wire.min.x(), 0.1 * std::numeric_limits<float>::epsilon());
}

}  // namespace
}  // namespace aureole
