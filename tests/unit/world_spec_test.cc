#include "server/transport/world_spec.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <map>
#include <set>
#include <string>
#include <vector>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_split.h>
#include <gtest/gtest.h>

#include "server/core/limits.h"
#include "server/transport/convex_hull.h"
#include "server/transport/world_json.h"

namespace aureole {
namespace {

const std::filesystem::path kWorlds = AUREOLE_WORLDS;

std::vector<std::filesystem::path> FilesIn(const std::filesystem::path& folder) {
  std::vector<std::filesystem::path> files;
  for (const auto& entry : std::filesystem::directory_iterator(folder)) {
    if (entry.path().extension() == ".json") files.push_back(entry.path());
  }
  std::sort(files.begin(), files.end());
  return files;
}

std::vector<std::filesystem::path> ShippedWorlds() {
  std::vector<std::filesystem::path> files = FilesIn(kWorlds);
  for (const auto& file : FilesIn(kWorlds / "paper")) files.push_back(file);
  return files;
}

World Load(const std::string& json) {
  absl::StatusOr<World> world = LoadWorld(json);
  if (!world.ok()) ADD_FAILURE() << world.status();
  return world.ok() ? *world : World(*Layout::Columns({}));
}

World LoadShipped(const std::string& name) {
  absl::StatusOr<World> world = LoadWorldFile((kWorlds / name).string());
  if (!world.ok()) ADD_FAILURE() << name << ": " << world.status();
  return world.ok() ? *world : World(*Layout::Columns({}));
}

v1::WorldSpec Spec(const std::filesystem::path& file) {
  absl::StatusOr<v1::WorldSpec> spec = SpecFromFile(file.string());
  if (!spec.ok()) ADD_FAILURE() << file << ": " << spec.status();
  return spec.ok() ? *spec : v1::WorldSpec();
}

// The path and the message of what LoadWorld says.
std::string Refusal(const std::string& json) {
  const absl::StatusOr<World> world = LoadWorld(json);
  if (world.ok()) return "accepted";
  EXPECT_EQ(world.status().code(), absl::StatusCode::kInvalidArgument);
  return std::string(world.status().message());
}

uint64_t InjectedInAll(const World& world) {
  uint64_t sum = 0;
  for (const Injector& injector : world.injectors)
    sum += InjectedBy(injector, world.environment.tick_us, Tick{1} << 30);
  return sum;
}

TEST(WorldSpec, EveryShippedWorldLoads) {
  const auto files = ShippedWorlds();
  EXPECT_GE(files.size(), 20u);
  for (const auto& file : files) {
    const absl::StatusOr<World> world = LoadWorldFile(file.string());
    ASSERT_TRUE(world.ok()) << file << ": " << world.status();
    EXPECT_EQ(world->name, file.stem().string());
    EXPECT_GT(world->bodies.size() + InjectedInAll(*world), 0u) << file;
  }
}

TEST(WorldSpec, EveryShippedWorldIsWideEnoughForDelayOne) {
  for (const auto& file : ShippedWorlds()) {
    v1::WorldSpec spec = Spec(file);
    spec.mutable_exchange()->set_delay(1);
    spec.mutable_exchange()->set_policy(v1::ExchangeSpec::REACH);
    const absl::StatusOr<World> world = WorldFromSpec(spec);
    ASSERT_TRUE(world.ok()) << file << ": " << world.status();
    EXPECT_EQ(world->exchange.k, 1);
    EXPECT_EQ(world->exchange.policy, AuraPolicy::kReach);
  }
}

TEST(WorldSpec, EveryBadWorldIsRefusedWithItsPath) {
  std::ifstream table(kWorlds / "bad" / "expected.txt");
  ASSERT_TRUE(table);
  std::set<std::string> named;
  for (std::string line; std::getline(table, line);) {
    if (line.empty() || line[0] == '#') continue;
    const std::vector<std::string> row = absl::StrSplit(line, " | ");
    ASSERT_EQ(row.size(), 3u) << line;
    named.insert(row[0]);
    const absl::StatusOr<World> world = LoadWorldFile((kWorlds / "bad" / row[0]).string());
    ASSERT_FALSE(world.ok()) << row[0] << " was accepted";
    EXPECT_EQ(world.status().code(), absl::StatusCode::kInvalidArgument) << row[0];
    const std::string message(world.status().message());
    EXPECT_TRUE(absl::StartsWith(message, row[1] + ":")) << row[0] << ": " << message;
    EXPECT_TRUE(absl::StrContains(message, row[2])) << row[0] << ": " << message;
  }
  EXPECT_GE(named.size(), 40u);
  for (const auto& file : FilesIn(kWorlds / "bad")) {
    EXPECT_TRUE(named.contains(file.filename().string())) << file << " is not in expected.txt";
  }
}

TEST(WorldSpec, AMissingFileIsNotFound) {
  EXPECT_EQ(LoadWorldFile("/nowhere/world.json").status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(LoadWorldFile(kWorlds.string()).status().code(), absl::StatusCode::kNotFound) << "a folder";
}

TEST(WorldSpec, JsonRoundTripKeepsTheSpecAndItsHash) {
  std::set<uint64_t> hashes;
  for (const auto& file : ShippedWorlds()) {
    const v1::WorldSpec spec = Spec(file);
    const absl::StatusOr<std::string> json = SpecToJson(spec);
    ASSERT_TRUE(json.ok()) << json.status();
    const absl::StatusOr<v1::WorldSpec> again = SpecFromJson(*json);
    ASSERT_TRUE(again.ok()) << again.status();
    EXPECT_EQ(WorldHash(*again), WorldHash(spec)) << file;
    hashes.insert(WorldHash(spec));
  }
  EXPECT_EQ(hashes.size(), ShippedWorlds().size()) << "different worlds, different hashes";
}

TEST(WorldSpec, TheHashOfAWorldNeverChanges) {
  const auto spec = SpecFromJson(R"({"name": "a", "shapes": {"x": {"sphere": {"radius": 1}}, "y": {}, "z": {}}})");
  ASSERT_TRUE(spec.ok());
  EXPECT_EQ(WorldHash(*spec), 11356246795257225675u);
}

TEST(WorldSpec, DefaultsAreThoseOfTheCore) {
  const World world = Load(R"({"name": "empty"})");
  const Environment environment;
  EXPECT_EQ(world.layout.size(), 1);
  EXPECT_EQ(world.seed, 1u);
  EXPECT_EQ(world.environment.gravity, environment.gravity);
  EXPECT_EQ(world.environment.tick_us, 16000);
  EXPECT_EQ(world.environment.sleep_after, environment.sleep_after);
  EXPECT_EQ(world.environment.iterations, environment.iterations);
  EXPECT_EQ(world.tolerances.speed, 32);
  EXPECT_EQ(world.tolerances.frame_us, 15000);
  EXPECT_EQ(world.tolerances.latency_us, 2000);
  EXPECT_EQ(world.tolerances.tick_us, world.environment.tick_us);
  EXPECT_EQ(world.exchange.k, Exchange().k);
}

TEST(WorldSpec, ReadsWhatIsWritten) {
  const World world = Load(R"({
    "name": "all", "seed": "18446744073709551615", "gravity": {"y": -1.62}, "tick": "0.010s",
    "tolerances": {"speed": 50, "latency": "0.001s", "frame_time": "0.008s", "clock_skew": "0.0005s"},
    "exchange": {"delay": 2, "policy": "REACH"},
    "layout": {"columns": {"edges": [-100, 100]}, "ranks": [2, 0, 1]},
    "speedLimit": 70, "sleeping": {"after": "1s", "linear": 0.5, "angular": 0.25}, "iterations": 20,
    "materials": {"default": {"friction": 0.5}, "ice": {"friction": 0}},
    "bodies": [{"shape": {"box": {"size": {"x": 1, "y": 2, "z": 3}}}, "density": 10, "velocity": {"z": 3},
                "angular_velocity": {"y": 1}, "material": "ice", "ccd": true}]
  })");
  EXPECT_EQ(world.seed, UINT64_MAX);
  EXPECT_EQ(world.environment.gravity, Vec3(0, -1.62, 0));
  EXPECT_EQ(world.environment.tick_us, 10000);
  EXPECT_EQ(world.environment.speed_limit, 70);
  EXPECT_EQ(world.environment.sleep_after, 1);
  EXPECT_EQ(world.environment.sleep_linear, 0.5);
  EXPECT_EQ(world.environment.sleep_angular, 0.25);
  EXPECT_EQ(world.environment.iterations, 20);
  EXPECT_EQ(world.tolerances.speed, 50);
  EXPECT_EQ(world.tolerances.latency_us, 1000);
  EXPECT_EQ(world.tolerances.frame_us, 8000);
  EXPECT_EQ(world.tolerances.skew_us, 500);
  EXPECT_EQ(world.exchange.k, 2);
  EXPECT_EQ(world.exchange.policy, AuraPolicy::kReach);
  EXPECT_EQ(world.layout.size(), 3);
  EXPECT_EQ(world.layout.rank(0), 2);
  ASSERT_EQ(world.bodies.size(), 1u);
  const BodySpec& body = world.bodies[0];
  EXPECT_EQ(body.id, 1u);
  EXPECT_EQ(body.shape->half, Vec3(0.5, 1, 1.5));
  EXPECT_DOUBLE_EQ(body.mass, 60);
  EXPECT_EQ(body.velocity, Vec3(0, 0, 3));
  EXPECT_EQ(body.angular_velocity, Vec3(0, 1, 0));
  EXPECT_EQ(body.material.friction, 0);
  EXPECT_TRUE(body.ccd);
}

TEST(WorldSpec, BodiesWithoutIdGetTheFreeOnesInOrder) {
  const World world = Load(R"({
    "name": "ids", "shapes": {"b": {"sphere": {"radius": 0.4}}},
    "bodies": [{"shape": {"named": "b"}, "array": {"x": 2, "spacing": {"x": 1}}},
               {"id": 3, "shape": {"named": "b"}}, {"shape": {"named": "b"}}],
    "statics": [{"shape": {"plane": {"normal": {"y": 1}}}}],
    "events": [{"spawn": {"shape": {"named": "b"}}}],
    "movers": [{"shape": {"named": "b"}, "keys": [{}]}]
  })");
  ASSERT_EQ(world.bodies.size(), 4u);
  for (BodyId id = 1; id <= 4; ++id) EXPECT_EQ(world.bodies[id - 1].id, id);
  ASSERT_EQ(world.environment.fixed.size(), 2u);
  EXPECT_EQ(world.environment.fixed[0].id, 5u);
  EXPECT_EQ(world.environment.fixed[0].motion, Motion::kKinematic);
  EXPECT_EQ(world.environment.fixed[1].id, 6u);
  EXPECT_EQ(world.environment.fixed[1].motion, Motion::kStatic);
  EXPECT_EQ(world.script.at(0).body, 7u);
  EXPECT_EQ(world.bodies[0].shape, world.bodies[3].shape) << "a named shape is one object";
}

TEST(WorldSpec, AnArrayIsLaidLayerUponLayer) {
  const World world = Load(R"({
    "name": "wall", "bodies": [{"id": 10, "shape": {"sphere": {"radius": 0.5}}, "position": {"x": 1, "y": 2, "z": 3},
      "array": {"x": 2, "y": 2, "z": 2, "spacing": {"x": 1, "y": 2, "z": -3}, "stagger": {"x": 0.5}}}]
  })");
  ASSERT_EQ(world.bodies.size(), 8u);
  const Vec3 expected[8] = {{1, 2, 3},   {2, 2, 3},   {1, 2, 0},   {2, 2, 0},
                            {1.5, 4, 3}, {2.5, 4, 3}, {1.5, 4, 0}, {2.5, 4, 0}};
  for (int i = 0; i < 8; ++i) {
    EXPECT_EQ(world.bodies[i].id, 10u + i);
    EXPECT_EQ(world.bodies[i].position, expected[i]) << i;
  }
}

TEST(WorldSpec, MassFollowsFromDensityAndShape) {
  const World world = Load(R"({"name": "masses", "bodies": [
    {"shape": {"sphere": {"radius": 0.5}}},
    {"shape": {"capsule": {"radius": 0.3, "height": 2}}},
    {"shape": {"cylinder": {"radius": 0.5, "height": 2}}, "density": 1},
    {"shape": {"hull": {"points": [{"x": 1, "y": 1, "z": 1}, {"x": -1, "y": 1, "z": 1}, {"x": 1, "y": -1, "z": 1},
      {"x": -1, "y": -1, "z": 1}, {"x": 1, "y": 1, "z": -1}, {"x": -1, "y": 1, "z": -1}, {"x": 1, "y": -1, "z": -1},
      {"x": -1, "y": -1, "z": -1}, {"x": 1}, {"x": 0.2, "y": 0.3}]}}, "density": 2},
    {"shape": {"compound": {"children": [{"shape": {"sphere": {"radius": 1}}},
                                         {"shape": {"box": {"size": {"x": 1, "y": 1, "z": 1}}}}]}}, "density": 3},
    {"shape": {"sphere": {"radius": 0.5}}, "mass": 5}
  ]})");
  ASSERT_EQ(world.bodies.size(), 6u);
  const double pi = 3.14159265358979323846;
  EXPECT_DOUBLE_EQ(world.bodies[0].mass, 1000 * pi / 6);
  EXPECT_DOUBLE_EQ(world.bodies[1].mass, 1000 * (pi * 0.09 * 1.4 + 4.0 / 3 * pi * 0.027));
  EXPECT_DOUBLE_EQ(world.bodies[2].mass, pi / 2);
  EXPECT_NEAR(world.bodies[3].mass, 16, 1e-12) << "a cube of 2 m with points inside a face and inside the body";
  EXPECT_DOUBLE_EQ(world.bodies[4].mass, 3 * (4.0 / 3 * pi + 1));
  EXPECT_DOUBLE_EQ(world.bodies[5].mass, 5);
}

TEST(WorldSpec, ATurnIsExactAtRightAnglesAndCloseElsewhere) {
  for (int degrees = -360; degrees <= 360; degrees += 15) {
    const World world = Load(absl::StrCat(R"({"name": "turn", "bodies": [{"shape": {"sphere": {"radius": 1}},
        "turn": {"axis": {"x": 1, "z": 2, "y": 2}, "degrees": )",
                                          degrees, "}}]}"));
    const Quat q = world.bodies.at(0).orientation;
    const double half = degrees * 3.14159265358979323846 / 360;
    EXPECT_NEAR(q.w(), std::cos(half), 1e-15) << degrees;
    EXPECT_NEAR(q.x(), std::sin(half) / 3, 1e-15) << degrees;
    EXPECT_NEAR(q.y(), std::sin(half) * 2 / 3, 1e-15) << degrees;
    EXPECT_NEAR(q.norm(), 1, 1e-15);
  }
  const World flip = Load(R"({"name": "turn", "bodies": [{"shape": {"sphere": {"radius": 1}},
      "turn": {"axis": {"y": 5}, "degrees": 180}}]})");
  EXPECT_EQ(flip.bodies.at(0).orientation.coeffs(), Quat(0, 0, 1, 0).coeffs());
}

TEST(WorldSpec, OrientationsAndNormalsAreNormalised) {
  const World world = Load(R"({"name": "unit",
    "bodies": [{"shape": {"sphere": {"radius": 1}}, "orientation": {"y": 3, "w": 4}}],
    "statics": [{"shape": {"plane": {"normal": {"x": 3, "y": 4}, "offset": 2}}}]})");
  EXPECT_EQ(world.bodies.at(0).orientation.coeffs(), Quat(0.8, 0, 0.6, 0).coeffs());
  EXPECT_EQ(world.environment.fixed.at(0).shape->normal, Vec3(0.6, 0.8, 0));
  EXPECT_EQ(world.environment.fixed.at(0).shape->offset, 2);
}

TEST(WorldSpec, JointPivotsAreTheSamePointSeenFromBothBodies) {
  const World world = Load(R"({"name": "chain", "bodies": [
      {"shape": {"sphere": {"radius": 1}}, "position": {"x": 1}, "turn": {"axis": {"y": 1}, "degrees": 70}},
      {"shape": {"sphere": {"radius": 1}}, "position": {"x": 3, "y": 2}, "turn": {"axis": {"x": 1}, "degrees": 20}}],
    "joints": [{"a": 1, "b": 2, "at": {"x": 2, "y": 1}, "hinge": {"axis": {"x": 1, "y": 1}, "lower_degrees": -90,
      "upper_degrees": 45}}, {"a": 2, "at": {"y": 5}, "fixed": {}}, {"a": 1, "b": 2, "fixed": {}, "collide": true}]})");
  ASSERT_EQ(world.joints.size(), 3u);
  const JointSpec& hinge = world.joints[0];
  const BodySpec &a = world.bodies[0], &b = world.bodies[1];
  EXPECT_LT((a.position + a.orientation * hinge.pivot_a - Vec3(2, 1, 0)).norm(), 1e-15);
  EXPECT_LT((b.position + b.orientation * hinge.pivot_b - Vec3(2, 1, 0)).norm(), 1e-15);
  EXPECT_LT((a.orientation * hinge.axis_a - b.orientation * hinge.axis_b).norm(), 1e-15);
  EXPECT_TRUE(hinge.limited);
  EXPECT_DOUBLE_EQ(hinge.lower, -3.14159265358979323846 / 2);
  EXPECT_FALSE(hinge.collide);
  EXPECT_EQ(world.joints[1].b, 0u);
  EXPECT_EQ(world.joints[1].pivot_b, Vec3(0, 5, 0)) << "of the world itself";
  EXPECT_TRUE((a.orientation * world.joints[2].frame_a).isApprox(b.orientation * world.joints[2].frame_b, 1e-15));
  EXPECT_TRUE(world.joints[2].collide);
}

TEST(WorldSpec, EventsTakeEffectAtTheFirstTickAtOrAfterTheirTime) {
  const World world = Load(R"({"name": "events", "bodies": [{"shape": {"sphere": {"radius": 1}}}],
    "events": [{"at": "0.033s", "remove": 1}, {"at": "0.032s", "impulse": {"body": 1, "linear": {"x": 4}}},
               {"velocity": {"body": 1, "angular": {"y": 2}}}]})");
  ASSERT_EQ(world.script.size(), 3u);
  EXPECT_TRUE(std::is_sorted(world.script.begin(), world.script.end()));
  EXPECT_EQ(world.script[0].tick, 1) << "there is no tick before";
  EXPECT_EQ(world.script[0].kind, Input::Kind::kVelocity);
  EXPECT_EQ(world.script[0].angular, Vec3(0, 2, 0));
  EXPECT_EQ(world.script[1].tick, 2);
  EXPECT_EQ(world.script[1].linear, Vec3(4, 0, 0));
  EXPECT_EQ(world.script[2].tick, 3);
  EXPECT_EQ(world.script[2].kind, Input::Kind::kRemove);
  for (size_t i = 0; i < 3; ++i) EXPECT_EQ(world.script[i].sequence, i + 1);
}

TEST(WorldSpec, ScriptsKeepTheirKeysAndPeriod) {
  const World world = Load(R"({"name": "mover", "movers": [{"shape": {"sphere": {"radius": 1}}, "period": "4s",
    "keys": [{"time": "0.5s", "position": {"x": 1}}, {"time": "2s", "turn": {"axis": {"y": 1}, "degrees": 180}}]}]})");
  const BodySpec& mover = world.environment.fixed.at(0);
  ASSERT_TRUE(mover.script);
  EXPECT_EQ(mover.script->period, 4);
  ASSERT_EQ(mover.script->keys.size(), 2u);
  EXPECT_EQ(mover.script->keys[0].time, 0.5);
  EXPECT_EQ(mover.script->keys[1].orientation.y(), 1);
  EXPECT_EQ(mover.position, Vec3(1, 0, 0)) << "stands at its first key at the start";
}

TEST(WorldSpec, AnEnormousArrayIsRefusedAtOnce) {
  EXPECT_TRUE(absl::StrContains(
      Refusal(R"({"name": "a", "bodies": [{"shape": {"sphere": {"radius": 1}}, "array": {"x": 4294967295,
          "y": 4294967295, "z": 4294967295, "spacing": {"x": 1, "y": 1, "z": 1}}}]})"),
      "bodies[0].array: must leave the world at most kMaxBodies"));
}

TEST(WorldSpec, AMessageRepeatsOnlyTheBeginningOfAWrongValue) {
  const std::string message = Refusal(absl::StrCat(R"({"name": "a", "seed": ")", std::string(1 << 20, 'x'), R"("})"));
  EXPECT_TRUE(absl::StartsWith(message, "seed: must be a whole number, 0 or more (is \"xxx")) << message;
  EXPECT_LT(message.size(), 200u);
}

TEST(WorldSpec, ADamagedTextIsLoadedOrRefusedButNeverWorse) {
  uint64_t state = 1;
  const auto random = [&state](uint64_t n) {
    state = state * 6364136223846793005u + 1442695040888963407u;
    return (state >> 33) % n;
  };
  int refused = 0;
  for (const char* name : {"shapes.json", "bridge.json", "demo.json"}) {
    const std::string whole = *SpecToJson(Spec(kWorlds / name));
    for (int round = 0; round < 150; ++round) {
      std::string text = whole;
      for (uint64_t hits = 1 + random(2); hits > 0; --hits) {
        text[random(text.size())] = "0123456789-.eE,:{}[]\"x"[random(22)];
      }
      const absl::StatusOr<World> world = LoadWorld(text);
      if (world.ok()) continue;
      ++refused;
      EXPECT_EQ(world.status().code(), absl::StatusCode::kInvalidArgument);
      EXPECT_TRUE(absl::StrContains(world.status().message(), ": ")) << world.status();
    }
  }
  EXPECT_GT(refused, 100);
}

TEST(WorldSpec, ADurationFromTheWireMayBeAnything) {
  v1::WorldSpec spec;
  spec.set_name("wire");
  spec.mutable_tick()->set_seconds(INT64_MAX);
  EXPECT_TRUE(absl::StartsWith(WorldFromSpec(spec).status().message(), "tick: must be from 0.001 s to 0.1 s"));
  spec.mutable_tick()->set_seconds(INT64_MIN);
  EXPECT_FALSE(WorldFromSpec(spec).ok());
}

TEST(WorldSpec, ATextThatIsTooLargeIsRefused) {
  EXPECT_TRUE(absl::StrContains(Refusal(std::string(limits::kMaxWorldFileBytes + 1, ' ')), "kMaxWorldFileBytes"));
}

// With one world for all layouts the total load is equal, and the hash of the final state too.
TEST(PaperWorlds, AllColumnsAndAllCornersAreOneWorldCutDifferently) {
  const std::map<std::string, std::vector<int>> families = {{"column", {1, 2, 3, 4, 5, 6, 7, 8, 9, 10}},
                                                            {"corner", {1, 3, 4, 9}}};
  for (const auto& [family, sizes] : families) {
    std::set<uint64_t> rest;
    for (const int n : sizes) {
      const std::string name = absl::StrCat(family, "-", n);
      EXPECT_EQ(LoadShipped(absl::StrCat("paper/", name, ".json")).layout.size(), n);
      v1::WorldSpec spec = Spec(kWorlds / "paper" / absl::StrCat(name, ".json"));
      spec.clear_name();
      spec.clear_description();
      spec.clear_layout();
      rest.insert(WorldHash(spec));
    }
    EXPECT_EQ(rest.size(), 1u) << family;
  }
}

TEST(PaperWorlds, TheNumbersAreThoseOfSectionFive) {
  for (const char* name : {"paper/column-10.json", "paper/corner-9.json"}) {
    const World world = LoadShipped(name);
    EXPECT_EQ(InjectedInAll(world), 9600u) << "160 bodies/s for 60 s";
    EXPECT_EQ(world.environment.tick_us, 16000);
    EXPECT_EQ(world.tolerances.speed, 32);
    EXPECT_EQ(world.tolerances.latency_us, 2000);
    EXPECT_EQ(world.tolerances.frame_us, 15000);
    ASSERT_EQ(world.injectors.size(), 2u);
    const double friction = world.injectors[0].shapes.at(0).material.friction;
    EXPECT_DOUBLE_EQ(friction * friction, 0.5);
    for (int i = 0; i < 2; ++i) {
      const Injector& injector = world.injectors[i];
      EXPECT_EQ(InjectedBy(injector, 16000, 3750), 4800u) << "half of them";
      EXPECT_EQ(injector.min_velocity, Vec3(-10, -10, -10));
      EXPECT_EQ(injector.max_velocity, Vec3(10, 0, 10));
      ASSERT_EQ(injector.shapes.size(), 3u);
      EXPECT_EQ(injector.shapes[0].weight, injector.shapes[2].weight);
      for (const Injector::Volume& volume : injector.volumes) {
        const Vec3 size = volume.max - volume.min;
        EXPECT_DOUBLE_EQ(size.x() * size.y() * size.z(), i == 0 ? 20 * 20 * 150 : 20 * 20 * 20);
        EXPECT_DOUBLE_EQ((volume.min.y() + volume.max.y()) / 2, 15);
      }
    }
  }
}

// So that one server of n can have 1/n of the load: no region gets more than 1.15/n of the injected bodies.
TEST(PaperWorlds, EveryLayoutSharesTheInjectedBodiesFairly) {
  for (const auto& file : FilesIn(kWorlds / "paper")) {
    const absl::StatusOr<World> world = LoadWorldFile(file.string());
    ASSERT_TRUE(world.ok()) << file << ": " << world.status();
    std::vector<int> share(world->layout.size());
    std::vector<Input> spawns;
    for (Tick n = 1; n <= 3750; ++n) InjectorInputs(world->injectors, world->seed, 16000, n, &spawns);
    ASSERT_EQ(spawns.size(), 9600u);
    for (const Input& input : spawns) ++share[world->layout.Home(input.spawn->position)];
    EXPECT_LE(*std::max_element(share.begin(), share.end()) * world->layout.size(), 1.15 * 9600) << file;
  }
}

TEST(ConvexHull, MeasuresATetrahedron) {
  const HullMeasure m = MeasureHull({{-1, -1, -1}, {3, -1, -1}, {-1, 3, -1}, {-1, -1, 3}});
  EXPECT_NEAR(m.volume, 64.0 / 6, 1e-12);
  EXPECT_GT(m.depth, 0);
  EXPECT_LT(MeasureHull({{1, 0, 0}, {2, 0, 0}, {1, 1, 0}, {1, 0, 1}}).depth, 0) << "the origin is outside";
}

}  // namespace
}  // namespace aureole
