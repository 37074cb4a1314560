// Poses as integers: how far they may be off.
#include "server/transport/quantise.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

namespace aureole {
namespace {

Quat Orientation(const QuantisedPose& q, const Quanta& quanta) {
  Eigen::Vector4d c;
  double rest = 1;
  for (int from = 0, to = 0; to < 4; ++to) {
    if (to == q.largest) continue;
    c[to] = q.orientation[from++] * quanta.orientation;
    rest -= c[to] * c[to];
  }
  c[q.largest] = std::sqrt(std::max(0.0, rest));
  return Quat(c[3], c[0], c[1], c[2]);
}

TEST(Quantise, ErrorStaysWithinTheStatedBounds) {
  std::mt19937_64 random(1);
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> coordinate(-1e5, 1e5);
  struct Bound {
    Quanta quanta;
    double metres, degrees;
  };
  for (const Bound& bound : {Bound{kFineQuanta, 0.5e-3, 0.05}, Bound{kCoarseQuanta, 7e-3, 0.4}}) {
    double most_metres = 0, most_degrees = 0;
    uint8_t largest = 3;
    BodyPose pose;
    pose.orientation = Quat::Identity();
    for (int n = 0; n < 200000; ++n) {
      // Small turns, which keep the left-out component for long, and now and then any other orientation.
      const double size = n % 100 == 0 ? 10 : 0.05;
      pose.orientation.coeffs() +=
          size * Eigen::Vector4d(normal(random), normal(random), normal(random), normal(random));
      pose.orientation.normalize();
      pose.position = {coordinate(random), coordinate(random), coordinate(random)};
      const QuantisedPose q = Quantise(pose, bound.quanta, largest);
      largest = q.largest;
      const Vec3 told = Vec3(q.position[0], q.position[1], q.position[2]) * bound.quanta.position;
      most_metres = std::max(most_metres, (told - pose.position).norm());
      const double angle = pose.orientation.angularDistance(Orientation(q, bound.quanta).normalized());
      most_degrees = std::max(most_degrees, angle * 180 / 3.14159265358979323846);
    }
    EXPECT_LE(most_metres, bound.metres);
    EXPECT_LE(most_degrees, bound.degrees);
    EXPECT_GT(most_degrees, bound.degrees / 4) << "else fewer bits would do";
  }
}

TEST(Quantise, LeftOutComponentStaysWhileItMay) {
  BodyPose pose;
  pose.orientation = Quat(0.6, 0.62, 0.35, 0).normalized();  // w, x, y, z
  EXPECT_EQ(Quantise(pose, kFineQuanta, 3).largest, 3) << "although x is larger";
  pose.orientation = Quat(0.3, 0.62, 0.35, 0).normalized();
  EXPECT_EQ(Quantise(pose, kFineQuanta, 3).largest, 0);
  pose.orientation = Quat(-0.9, 0.1, 0.2, 0).normalized();
  const QuantisedPose q = Quantise(pose, kFineQuanta, 3);
  EXPECT_LT(q.orientation[0], 0) << "the sign that makes the left-out one positive";
}

TEST(Quantise, SleepingBodyHasNoVelocity) {
  BodyPose pose;
  pose.velocity = {1, 2, 3};
  pose.angular_velocity = {-1, 0, 1};
  EXPECT_EQ(Quantise(pose, kFineQuanta, 3).velocity, (std::array<int32_t, 6>{64, 128, 192, -64, 0, 64}));
  pose.asleep = true;
  EXPECT_EQ(Quantise(pose, kFineQuanta, 3).velocity, (std::array<int32_t, 6>{}));
}

}  // namespace
}  // namespace aureole
