#include "client/cli/crowd_world.h"

#include <algorithm>
#include <cmath>
#include <string>

#include <gtest/gtest.h>

#include "client/cli/experiment.h"
#include "client/cli/policies.h"
#include "client/cli/policies_report.h"
#include "server/transport/world_spec.h"

namespace aureole {
namespace {

double Radius(const v1::Body& b) {
  return b.shape().has_sphere() ? b.shape().sphere().radius() : b.shape().box().size().x() / 2 * std::sqrt(3.0);
}

double Speed(const v1::Event& e) { return std::hypot(e.velocity().linear().x(), e.velocity().linear().z()); }

TEST(CrowdWorld, IsAFunctionOfItsSeed) {
  const Crowd crowd{0.2, true, 7, 100};
  EXPECT_EQ(WorldHash(CrowdWorld(crowd)), WorldHash(CrowdWorld(crowd)));
  Crowd other = crowd;
  other.seed = 8;
  EXPECT_NE(WorldHash(CrowdWorld(crowd)), WorldHash(CrowdWorld(other)));
}

TEST(CrowdWorld, LoadsUnderEveryExchange) {
  const v1::WorldSpec crowd = CrowdWorld({1, true, 1, 10});
  for (const ExchangeChoice& exchange : kExchangeChoices) {
    const v1::WorldSpec spec = WithExchange(crowd, exchange);
    const absl::StatusOr<World> world = WorldFromSpec(spec);
    ASSERT_TRUE(world.ok()) << exchange.Name() << ": " << world.status();
    EXPECT_EQ(world->layout.size(), 2);
    EXPECT_EQ(world->exchange.k, exchange.k);
    EXPECT_EQ(world->exchange.policy == AuraPolicy::kReach, exchange.reach);
    EXPECT_EQ(world->environment.speed_limit, world->tolerances.speed);
    EXPECT_EQ(ContentKey(spec), ContentKey(crowd)) << "one undivided run is the reference of all";
  }
}

TEST(CrowdWorld, BodiesLieApartInTheArena) {
  const v1::WorldSpec spec = CrowdWorld({1, false, 3, 1});
  ASSERT_EQ(spec.bodies_size(), 2400);
  int spheres = 0;
  for (int i = 0; i < spec.bodies_size(); ++i) {
    const v1::Body& a = spec.bodies(i);
    spheres += a.shape().has_sphere();
    ASSERT_GE(Radius(a), 0.2 - 1e-9);
    ASSERT_LE(Radius(a), 0.4 + 1e-9);
    ASSERT_LE(std::abs(a.position().x()) + Radius(a), kCrowdWidth / 2 + 1e-9);
    ASSERT_LE(std::abs(a.position().z()) + Radius(a), kCrowdDepth / 2 + 1e-9);
    for (int j = 0; j < i; ++j) {
      const v1::Body& b = spec.bodies(j);
      const double dx = a.position().x() - b.position().x(), dz = a.position().z() - b.position().z();
      ASSERT_GT(std::hypot(dx, dz), Radius(a) + Radius(b)) << a.id() << ", " << b.id();
    }
  }
  EXPECT_NEAR(spheres, 1200, 150);
}

TEST(CrowdWorld, OnePerCentOfTheBodiesIsKickedInEachTick) {
  const v1::WorldSpec slow = CrowdWorld({0.5, false, 1, 1000});
  EXPECT_NEAR(slow.events_size(), 12000, 400);
  for (const v1::Event& e : slow.events()) ASSERT_LE(Speed(e), 5 + 1e-9);
  EXPECT_EQ(slow.events(0).at().seconds(), 0);
  EXPECT_EQ(slow.events(slow.events_size() - 1).at().seconds(), 16);
}

TEST(CrowdWorld, TwoPerCentOfTheFastKicksAreFast) {
  const v1::WorldSpec world = CrowdWorld({0.5, true, 1, 1000});
  const auto fast = std::count_if(world.events().begin(), world.events().end(),
                                  [](const v1::Event& e) { return Speed(e) > 5 + 1e-9; });
  EXPECT_NEAR(static_cast<double>(fast), 0.02 * world.events_size(), 50);
  for (const v1::Event& e : world.events()) ASSERT_LE(Speed(e), 32 + 1e-9);
}

}  // namespace
}  // namespace aureole
