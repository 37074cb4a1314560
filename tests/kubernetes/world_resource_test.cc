// A World object is read whole or refused with the field, in words that help.
#include "server/control/kubernetes/world_resource.h"

#include <gtest/gtest.h>

#include <absl/strings/match.h>

namespace aureole::kubernetes {
namespace {

const PodDefaults kDefaults{.image = "own", .pull_policy = "Never", .flags = {"--insecure"}};

Json World() {
  return {{"metadata", {{"name", "demo"}, {"namespace", "games"}, {"uid", "u"}, {"generation", 3}}},
          {"spec",
           {{"world", {{"name", "demo"}, {"layout", {{"grid", {{"x_edges", {0}}, {"z_edges", {0}}}}}}}},
            {"storage", {{"emptyDir", Json::object()}}}}}};
}

WorldResource Read(const Json& object, const std::optional<std::string>& file = std::nullopt) {
  const absl::StatusOr<WorldResource> world = ReadWorld(object, file, kDefaults);
  EXPECT_TRUE(world.ok()) << world.status();
  return world.ok() ? *world : WorldResource();
}

TEST(WorldResource, WhatIsNotGivenIsSane) {
  const WorldResource world = Read(World());
  EXPECT_EQ(world.name, "demo");
  EXPECT_EQ(world.space, "games");
  EXPECT_EQ(world.uid, "u");
  EXPECT_EQ(world.generation, 3);
  EXPECT_EQ(world.run.regions, 4);
  EXPECT_EQ(world.run.world_name, "demo");
  EXPECT_FALSE(world.run.no_real_time);
  EXPECT_EQ(world.run.last_tick, 0);
  EXPECT_EQ(world.run.hash_every, 0);
  EXPECT_GT(world.run.checkpoint_every, 0);
  EXPECT_EQ(world.pods.image, "own");
  EXPECT_EQ(world.pods.pull_policy, "Never");
  EXPECT_EQ(world.pods.flags, kDefaults.flags);
  EXPECT_EQ(world.pods.storage, Storage());
}

TEST(WorldResource, EveryFieldIsTakenOver) {
  Json object = World();
  object["spec"].update(Json{{"image", "mine"},
                             {"resources", {{"limits", {{"cpu", 1}}}}},
                             {"nodeSelector", {{"a", "b"}}},
                             {"tolerations", Json::array({{{"key", "k"}}})},
                             {"serviceAccountName", "sa"},
                             {"checkpointSeconds", 2},
                             {"storage", {{"volumeClaim", {{"storageClassName", "fast"}, {"size", "1Gi"}}}}},
                             {"realTime", false},
                             {"duration", "32s"},
                             {"hashEvery", 10},
                             {"replicas", 4},
                             {"policy", "Wait"}});
  const WorldResource world = Read(object);
  EXPECT_EQ(world.pods.image, "mine");
  EXPECT_EQ(world.pods.pull_policy, "") << "that was of the other image";
  EXPECT_EQ(world.pods.resources, object["spec"]["resources"]);
  EXPECT_EQ(world.pods.node_selector, object["spec"]["nodeSelector"]);
  EXPECT_EQ(world.pods.tolerations, object["spec"]["tolerations"]);
  EXPECT_EQ(world.pods.service_account, "sa");
  EXPECT_EQ(world.pods.storage.storage_class, "fast");
  EXPECT_EQ(world.pods.storage.size, "1Gi");
  EXPECT_TRUE(world.run.no_real_time);
  EXPECT_EQ(world.run.hash_every, 10);
  EXPECT_EQ(world.run.last_tick, 16 * world.run.checkpoint_every);
}

TEST(WorldResource, NeighboursTouch) {
  Json object = World();
  object["spec"]["world"]["layout"] = {{"columns", {{"edges", {0, 10}}}}};
  const std::vector<std::vector<RegionId>> row = {{1}, {0, 2}, {1}};
  EXPECT_EQ(Read(object).pods.neighbours, row);
  const std::vector<RegionId> corner = {1, 2, 3};
  EXPECT_EQ(Read(World()).pods.neighbours[0], corner);
}

TEST(WorldResource, WorldMayBeInAConfigMap) {
  Json object = World();
  const std::string file = object["spec"]["world"].dump();
  EXPECT_FALSE(SourceOf(object));
  object["spec"].erase("world");
  object["spec"]["worldFrom"] = {{"configMap", "worlds"}, {"key", "demo.json"}};
  ASSERT_TRUE(SourceOf(object));
  EXPECT_EQ(SourceOf(object)->config_map, "worlds");
  EXPECT_EQ(SourceOf(object)->key, "demo.json");
  const WorldResource world = Read(object, file);
  EXPECT_EQ(world.run.regions, 4);
  EXPECT_EQ(world.world_hash, Read(World()).world_hash);
}

TEST(WorldResource, FixedPartIsWhatARunCannotChange) {
  const WorldResource before = Read(World());
  Json object = World();
  object["spec"]["image"] = "newer";
  object["spec"]["tolerations"] = Json::array({{{"key", "k"}}});
  EXPECT_EQ(Read(object).fixed, before.fixed);
  EXPECT_EQ(Read(object).world_hash, before.world_hash);
  object["spec"]["world"]["seed"] = 5;
  EXPECT_NE(Read(object).world_hash, before.world_hash);
  object["spec"]["duration"] = "1s";
  object["spec"]["storage"] = {{"hostPath", "/a"}};
  EXPECT_NE(Read(object).fixed, before.fixed);
  const WorldResource back = Read(WithFixed(object, before.fixed));
  EXPECT_EQ(back.fixed, before.fixed);
  EXPECT_EQ(back.pods.image, "newer");
  EXPECT_EQ(back.run.last_tick, 0);
}

TEST(WorldResource, RefusalsNameTheFieldAndChangeNothing) {
  const struct {
    const char* field;  // path below spec, as a JSON pointer
    Json value;         // null: removed
    const char* message;
  } cases[] = {
      {"/world", nullptr, "spec.world: must be given, or worldFrom; not both"},
      {"/worldFrom", {{"configMap", "a"}, {"key", "b"}}, "spec.world: must be given, or worldFrom; not both"},
      {"/world/bodys", Json::array(), "spec.world.bodys: there is no such field"},
      {"/world/gravity", 3, "spec.world.gravity: must be an object"},
      {"/world/tick", "0s", "spec.world.tick"},
      {"/storage", nullptr, "spec.storage: must have exactly one of hostPath, volumeClaim and emptyDir"},
      {"/storage/hostPath", "/a", "spec.storage: must have exactly one"},
      {"/storage", {{"hostPath", "a"}}, "spec.storage.hostPath: must be a directory, from / on"},
      {"/storage", {{"volumeClaim", Json::object()}}, "spec.storage.volumeClaim.size: must be a quantity"},
      {"/realTime", "no", "spec.realTime: must be true or false"},
      {"/duration", "soon", "spec.duration: must be a time"},
      {"/duration", 5, "spec.duration: must be a time"},
      {"/hashEvery", -1, "spec.hashEvery: must be a number of ticks"},
      {"/hashEvery", "x", "spec.hashEvery: must be a number of ticks"},
      {"/checkpointSeconds", 0, "spec.checkpointSeconds: must be above 0"},
      {"/checkpointSeconds", "1s", "spec.checkpointSeconds: must be above 0"},
      {"/policy", "GoOn", "spec.policy: is GoOn; only Wait is possible"},
      {"/replicas", 65, "spec.replicas: is 65; regions allows 1 to 64"},
      {"/regions", {{"min", 5}, {"max", 4}}, "spec.regions.min: is 5, above max 4; exchange them"},
      {"/regions", {{"min", 0}, {"max", 4}}, "spec.regions.min: is 0; must be 1 to 64 regions"},
      {"/regions", {{"max", 65}}, "spec.regions.max: is 65; must be 1 to 64 regions"},
      {"/regions", {{"max", "many"}}, "spec.regions.max: is -1; must be 1 to 64 regions"},
      {"/regions", {{"max", 8}, {"framePercent", 0}}, "spec.regions.framePercent: is 0; must be 1 to 1000 percent"},
      {"/regions", {{"max", 8}, {"awakeBodies", -3}}, "spec.regions.awakeBodies: is -1; must be 1 to 1000000"},
      {"/regions", {{"max", 8}, {"upAfter", "soon"}}, "spec.regions.upAfter: must be a time such as \"5s\""},
      {"/regions", {{"max", 8}, {"upAfter", "1ms"}}, "spec.regions.upAfter: must be a time of 100ms to 24h"},
      {"/regions", {{"max", 8}, {"downAfter", "1s"}}, "spec.regions.downAfter: must be a time from upAfter"},
      {"/regions", {{"min", 5}}, "spec.replicas: is 4, as the layout has regions; regions allows 5 to 64"},
  };
  for (const auto& tested : cases) {
    Json object = World();
    if (tested.value.is_null()) {
      object["spec"].erase(tested.field + 1);
    } else {
      object["spec"][Json::json_pointer(tested.field)] = tested.value;
    }
    const absl::Status s = ReadWorld(object, std::nullopt, kDefaults).status();
    EXPECT_TRUE(absl::IsInvalidArgument(s)) << tested.field << ": " << s;
    EXPECT_TRUE(absl::StartsWith(s.message(), tested.message)) << s;
  }
}

TEST(WorldResource, ScalesItselfWhereAMaxIsAboveMin) {
  Json object = World();
  EXPECT_FALSE(Read(object).scaling.on());
  for (const Json& fixed : {Json{{"min", 1}}, Json{{"min", 4}, {"max", 4}}}) {
    object["spec"]["regions"] = fixed;
    EXPECT_FALSE(Read(object).scaling.on()) << fixed;
  }
  object["spec"]["regions"] = {{"max", 8}};
  ScalingOptions expected;
  expected.min_regions = 1;
  expected.max_regions = 8;
  EXPECT_EQ(Read(object).scaling, expected);
  object["spec"]["regions"] = {{"min", 2},           {"max", 8},        {"framePercent", 50},
                               {"awakeBodies", 300}, {"upAfter", "1s"}, {"downAfter", "10m"}};
  expected = {2, 8, 50, 300, std::chrono::seconds(1), std::chrono::minutes(10)};
  EXPECT_EQ(Read(object).scaling, expected);
}

TEST(WorldResource, ReplicasOutOfBoundsAreBroughtIntoThemWhereItScalesItself) {
  const struct {
    int min, max, given, replicas;
  } cases[] = {{1, 8, 0, 4}, {5, 8, 0, 5}, {1, 3, 0, 3}, {1, 8, 6, 6}, {1, 8, 9, 8}, {3, 8, 2, 3}};
  for (const auto& tested : cases) {
    Json object = World();
    object["spec"]["regions"] = {{"min", tested.min}, {"max", tested.max}};
    if (tested.given != 0) object["spec"]["replicas"] = tested.given;
    EXPECT_EQ(Read(object).replicas, tested.replicas);
    EXPECT_EQ(Read(object).replicas_given, tested.given);
  }
  Json object = World();
  object["spec"]["regions"] = {{"min", 3}, {"max", 3}};
  object["spec"]["replicas"] = 2;
  EXPECT_EQ(ReadWorld(object, std::nullopt, kDefaults).status().message(),
            "spec.replicas: is 2; regions allows 3 to 3");
}

TEST(WorldResource, AWorldWithADelayDoesNotScaleItself) {
  Json object = World();
  object["spec"]["world"]["exchange"] = {{"delay", 1}};
  object["spec"]["regions"] = {{"min", 2}, {"max", 8}};
  const absl::Status s = ReadWorld(object, std::nullopt, kDefaults).status();
  EXPECT_TRUE(absl::StartsWith(s.message(), "spec.regions: from 2 to 8 needs a layout that can change")) << s;
  EXPECT_TRUE(absl::StrContains(s.message(), "set exchange.delay to 0")) << s;
  object["spec"]["regions"] = {{"min", 4}, {"max", 4}};
  EXPECT_EQ(Read(object).replicas, 4);
}

TEST(WorldResource, OtherRefusalsNameThePlace) {
  Json object = World();
  object["spec"].erase("world");
  object["spec"]["worldFrom"] = {{"configMap", "worlds"}, {"key", "demo.json"}};
  const auto message = [&](const std::optional<std::string>& file) {
    return std::string(ReadWorld(object, file, kDefaults).status().message());
  };
  EXPECT_EQ(message(std::nullopt),
            "spec.worldFrom: worlds/demo.json: there is no such ConfigMap, or it has no such key");
  EXPECT_TRUE(absl::StartsWith(message("{"), "spec.worldFrom: worlds/demo.json: JSON: ")) << message("{");
  object["spec"]["worldFrom"].erase("key");
  EXPECT_EQ(message("{}"), "spec.worldFrom: must have configMap and key");
  object = World();
  EXPECT_EQ(ReadWorld(object, std::nullopt, {}).status().message(),
            "spec.image: is missing, and the control plane has none of its own to take");
  object["metadata"]["name"] = std::string(41, 'a');
  EXPECT_TRUE(absl::StartsWith(message(std::nullopt), "metadata.name: must have at most 40 characters"));
  object.erase("spec");
  object["metadata"]["name"] = "a";
  EXPECT_EQ(message(std::nullopt), "spec: is missing");
}

}  // namespace
}  // namespace aureole::kubernetes
