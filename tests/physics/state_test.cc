// Save, Extract and Restore.
#include <algorithm>

#include <gtest/gtest.h>

#include "server/physics/bullet_engine.h"
#include "tests/physics/scene.h"

namespace aureole {
namespace {

// A scene after some ticks, with contacts and joints of all kinds.
std::unique_ptr<Engine> Busy(const PhysicsScene& scene, Tick ticks) {
  auto engine = MakeBulletEngine(scene.environment);
  for (const BodySpec& b : scene.bodies) engine->Spawn(b);
  for (const JointSpec& j : scene.joints) engine->Join(j);
  for (Tick n = 1; n <= ticks; ++n) engine->Step(n);
  return engine;
}

uint64_t HashOf(const Engine& engine) {
  uint64_t hash = 0;
  for (BodyId id : engine.Ids()) hash = Mix(hash ^ engine.Hash(id));
  return hash;
}

TEST(State, RestoredStateSavesToTheSameBytes) {
  const PhysicsScene scene = MakePhysicsScene(1, 6, 15, 0);
  const auto engine = Busy(scene, 120);
  const std::string state = engine->Save(engine->Ids());
  const auto copy = engine->Scratch();
  ASSERT_TRUE(copy->Restore(state).ok());
  EXPECT_EQ(copy->Save(copy->Ids()), state);
  EXPECT_EQ(HashOf(*copy), HashOf(*engine));
  EXPECT_EQ(copy->Counts().awake, engine->Counts().awake);
}

TEST(State, RestoredWorldGoesOnWithTheSameBits) {
  const PhysicsScene scene = MakePhysicsScene(2, 6, 15, 0);
  const auto engine = Busy(scene, 150);
  const auto copy = engine->Scratch();
  ASSERT_TRUE(copy->Restore(engine->Save(engine->Ids())).ok());
  for (Tick n = 151; n <= 300; ++n) {
    engine->Step(n);
    copy->Step(n);
  }
  EXPECT_EQ(HashOf(*copy), HashOf(*engine));
  EXPECT_EQ(copy->Save(copy->Ids()), engine->Save(engine->Ids()));
}

TEST(State, ExtractAndRestoreIsNoChange) {
  const PhysicsScene scene = MakePhysicsScene(3, 4, 12, 0);
  const auto moved = Busy(scene, 100), stayed = Busy(scene, 100);
  for (Tick n = 101; n <= 160; ++n) {
    const std::string state = moved->Extract(moved->Ids());
    EXPECT_EQ(moved->Counts().bodies, 0);
    EXPECT_EQ(moved->Counts().contacts, 0);
    ASSERT_TRUE(moved->Restore(state).ok());
    moved->Step(n);
    stayed->Step(n);
    ASSERT_EQ(HashOf(*moved), HashOf(*stayed)) << "tick " << n;
  }
}

TEST(State, BodyThatIsHereIsRefusedAndNothingChanges) {
  const PhysicsScene scene = MakePhysicsScene(4, 2, 8, 0);
  const auto engine = Busy(scene, 60);
  const std::string before = engine->Save(engine->Ids());
  const absl::Status status = engine->Restore(before);
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_NE(std::string(status.message()).find("is already here"), std::string::npos);
  EXPECT_EQ(engine->Save(engine->Ids()), before);
}

TEST(State, StateOfAnotherTickIsRefusedWhereThingsMove) {
  const PhysicsScene scene = MakePhysicsScene(4, 2, 8, 0);
  const auto early = Busy(scene, 60), late = Busy(scene, 61);
  BodySpec other = scene.bodies[0];
  const auto target = MakeBulletEngine(scene.environment);
  other.id = 4242;
  other.position += Vec3(500, 0, 0);
  target->Spawn(other);
  target->Step(61);
  const absl::Status status = target->Restore(early->Save(early->Ids()));
  EXPECT_NE(std::string(status.message()).find("tick 60"), std::string::npos) << status;
  EXPECT_TRUE(target->Restore(late->Save(late->Ids())).ok());
}

// Restores damaged bytes; whatever they do to a body's future, they must not break the engine.
void TryDamaged(const std::string& bytes, Tick tick, Engine* engine) {
  const int64_t before = engine->Counts().bodies;
  const absl::Status status = engine->Restore(bytes);
  if (!status.ok()) {
    ASSERT_EQ(engine->Counts().bodies, before);
    ASSERT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
    return;
  }
  engine->Step(tick + 1);
  engine->Extract(engine->Ids());
}

TEST(State, DamagedBytesAreRefusedOrHarmless) {
  const PhysicsScene scene = MakePhysicsScene(5, 2, 10, 0);
  const auto engine = Busy(scene, 80);
  const std::string state = engine->Save(engine->Ids());
  const auto target = engine->Scratch();
  int64_t refused = 0;
  for (uint64_t i = 0; i < 3000; ++i) {
    std::string bytes = state;
    const uint64_t key = Mix(i * 31);
    const int flips = 1 + static_cast<int>(key % 3);
    for (int f = 0; f < flips; ++f) {
      const uint64_t at = Mix(key + static_cast<uint64_t>(f));
      bytes[at % bytes.size()] = static_cast<char>(bytes[at % bytes.size()] ^ (1 << (at >> 40) % 8));
    }
    if (!target->Restore(bytes).ok()) {
      ++refused;
      ASSERT_EQ(target->Counts().bodies, 0);
      continue;
    }
    target->Step(81);
    target->Extract(target->Ids());
  }
  EXPECT_GT(refused, 500);
  for (size_t length = 0; length < state.size(); length += 1 + state.size() / 700) {
    TryDamaged(state.substr(0, length), 80, target.get());
  }
  TryDamaged(state + "x", 80, target.get());
  for (uint64_t i = 0; i < 300; ++i) {
    std::string noise(Mix(i) % 400, '\0');
    for (size_t j = 0; j < noise.size(); ++j) noise[j] = static_cast<char>(Mix(i * 1000 + j));
    if (i % 2 == 0 && noise.size() > 16) noise.replace(0, 16, state, 0, 16);
    TryDamaged(noise, 80, target.get());
  }
  EXPECT_TRUE(target->Restore(state).ok());
}

}  // namespace
}  // namespace aureole
