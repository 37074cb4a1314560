// The snapshots of all regions after a tick are the state of the world: one server that resumes from them goes on, bit
// for bit, as the split world does.
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "server/physics/bullet_engine.h"
#include "server/transport/world_spec.h"
#include "tests/simulation/lockstep.h"

namespace aureole {
namespace {

Input Blow(uint64_t sequence, Tick ticks) {
  Input i;
  i.source = 5;
  i.sequence = sequence;
  i.kind = Input::Kind::kImpulse;
  i.area = {Vec3(0, 1, 0), 30, 2, true};
  i.linear = Vec3(0, 1, 0.5);
  i.ticks = ticks;
  return i;
}

Input Drop(uint64_t sequence) {
  auto ball = std::make_shared<Shape>();
  ball->radius = 0.4;
  auto body = std::make_shared<BodySpec>();
  body->shape = ball;
  body->position = Vec3(0.1, 12, 0.2);
  Input i;
  i.source = 5;
  i.sequence = sequence;
  i.kind = Input::Kind::kSpawn;
  i.spawn = body;
  return i;
}

class Snapshots : public testing::TestWithParam<const char*> {};

TEST_P(Snapshots, OneServerResumesFromThemBitForBit) {
  absl::StatusOr<World> world = LoadWorldFile(std::string(AUREOLE_WORLDS) + "/" + GetParam());
  ASSERT_TRUE(world.ok()) << world.status();
  ASSERT_EQ(world->exchange.k, 0);
  ASSERT_GT(world->layout.size(), 1);
  sim::Lockstep split(*std::move(world), MakeBulletEngine);
  uint64_t sequence = 0;
  for (const Tick from : {1, 70, 160}) {
    // A blow that lasts, and a body that is on its way in.
    split.RunTo(from - 1);
    ASSERT_TRUE(split.region(0).Submit(Blow(++sequence, 40)).ok());
    split.RunTo(from);
    ASSERT_TRUE(split.region(0).Submit(Drop(++sequence)).ok());
    split.RunTo(from + 1);
    std::vector<std::string> states;
    std::vector<Input> to_come;
    for (RegionId r = 0; r < split.world().layout.size(); ++r) {
      RegionSnapshot s = split.region(r).Snapshot();
      states.push_back(std::move(s.state));
      to_come = std::move(s.to_come);  // the same of all
    }
    EXPECT_GE(to_come.size(), 1u);
    absl::StatusOr<aureole::Undivided> whole =
        aureole::Undivided::Resume(split.world(), MakeBulletEngine(split.world().environment), from + 1, states);
    ASSERT_TRUE(whole.ok()) << whole.status();
    for (const Input& i : to_come) whole->Add(i);
    ASSERT_EQ(whole->Hash(), split.Hash()) << "at once, tick " << from + 1;
    for (Tick n = from + 2; n < from + 60; ++n) {
      split.RunTo(n);
      whole->RunTo(n);
      ASSERT_EQ(whole->Hash(), split.Hash()) << "resumed at " << from + 1 << ", tick " << n;
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Worlds, Snapshots,
                         testing::Values("demo.json", "bridge.json", "shapes.json", "corner-storm.json"),
                         [](const testing::TestParamInfo<const char*>& param) {
                           std::string file = param.param;
                           std::erase(file, '-');
                           return file.substr(0, file.find('.'));
                         });

}  // namespace
}  // namespace aureole
