// The shipped worlds, split, against the undivided world, body by body.
#include <gtest/gtest.h>

#include "server/physics/bullet_engine.h"
#include "server/transport/world_spec.h"
#include "tests/simulation/lockstep.h"

namespace aureole::sim {
namespace {

class ShippedWorld : public testing::TestWithParam<const char*> {};

TEST_P(ShippedWorld, SplitEqualsUndividedBitForBit) {
  absl::StatusOr<World> world = LoadWorldFile(std::string(AUREOLE_WORLDS) + "/" + GetParam());
  ASSERT_TRUE(world.ok()) << world.status();
  Lockstep split(*std::move(world), MakeBulletEngine);
  Undivided whole(split.world(), MakeBulletEngine);
  for (Tick n = 1; n <= 400; ++n) {
    split.RunTo(n);
    whole.RunTo(n);
    if (split.Hash() == whole.Hash()) continue;
    std::string differing;
    for (BodyId id : whole.engine().Ids()) {
      const RegionId owner = split.Owner(id);
      if (owner < 0 || split.region(owner).engine().Hash(id) != whole.engine().Hash(id)) {
        differing += " " + std::to_string(id) + "@" + std::to_string(owner);
      }
    }
    FAIL() << "tick " << n << ": bodies" << differing;
  }
}

INSTANTIATE_TEST_SUITE_P(All, ShippedWorld,
                         testing::Values("border-pile.json", "bridge.json", "bullet.json", "corner-storm.json",
                                         "demo.json", "fig1.json", "shapes.json", "paper/corner-9.json",
                                         "paper/column-10.json"),
                         [](const testing::TestParamInfo<const char*>& param) {
                           std::string name = param.param;
                           std::erase_if(name, [](char c) { return !std::isalnum(static_cast<unsigned char>(c)); });
                           return name;
                         });

}  // namespace
}  // namespace aureole::sim
