// A World's status says what is, in the words that people and tools look for.
#include "server/control/kubernetes/world_status.h"

#include <gtest/gtest.h>

#include <absl/strings/match.h>

namespace aureole::kubernetes {
namespace {

WorldResource World() {
  WorldResource world;
  world.name = "w";
  world.generation = 4;
  const double far = std::numeric_limits<double>::infinity();
  world.homes = {{-far, 0, -far, far}, {0, far, -far, far}};
  return world;
}

// Two regions that run.
RunStatus Running() {
  RunStatus run;
  run.stage = Stage::kRunning;
  run.start_unix_us = 1'700'000'000'000'000;
  for (int i = 0; i < 2; ++i) {
    RegionStatus& r = run.regions.emplace_back();
    r.joined = r.ready = r.was_ready = true;
    r.endpoint = "10.0.0.1:7000";
    r.reported = std::chrono::steady_clock::now();
    r.report.set_tick(100 + i);
    r.report.set_bodies(10 + i);
    r.report.set_awake(i);
    r.report.set_real_time_factor(1 - 0.123 * i);
    r.frame.set_mean_ms(1.2345);
  }
  return run;
}

PodView Pod(RegionId region) {
  PodView pod;
  pod.start.region = region;
  pod.name = PodName("w", region, 1);
  pod.node = "n1";
  pod.started = true;
  return pod;
}

const Condition& Of(const WorldStatus& status, const std::string& type) {
  for (const Condition& condition : status.conditions) {
    if (condition.type == type) return condition;
  }
  ADD_FAILURE() << "no condition " << type;
  return status.conditions.front();
}

TEST(WorldStatus, SaysWhatRuns) {
  RunStatus run = Running();
  EXPECT_FALSE(StatusOf(World(), run, {}).fields.contains("hash"));
  run.hash = {50, 0x1234, 21, 2, 2};
  const WorldStatus status = StatusOf(World(), run, {{0, Pod(0)}, {1, Pod(1)}});
  EXPECT_EQ(status.generation, 4);
  EXPECT_EQ(status.fields["hash"], (Json{{"tick", 50}, {"hash", "0000000000001234"}, {"bodies", 21}}));
  EXPECT_EQ(status.fields["phase"], "Running");
  EXPECT_EQ(status.fields["tick"], 100);
  EXPECT_EQ(status.fields["regionsReady"], "2/2");
  EXPECT_EQ(status.fields["replicas"], 2);
  EXPECT_EQ(status.fields["selector"], "aureole.dev/world=w");
  EXPECT_EQ(status.fields["bodies"], 21);
  EXPECT_EQ(status.fields["awake"], 1);
  EXPECT_EQ(status.fields["realTimeFactor"], 0.88);
  EXPECT_EQ(status.fields["startTime"], "2023-11-14T22:13:20Z");
  const Json region = {{"region", 1},      {"incarnation", 1}, {"phase", "Running"},
                       {"pod", "w-r1-i1"}, {"node", "n1"},     {"endpoint", "10.0.0.1:7000"},
                       {"bodies", 11},     {"awake", 1},       {"frameMs", 1.23},
                       {"dilation", 0.88}, {"tick", 101},      {"home", {{"minX", 0.0}}}};
  EXPECT_EQ(status.fields["regions"][1], region);
  EXPECT_TRUE(Of(status, "Ready").holds);
  EXPECT_TRUE(Of(status, "Exact").holds);
  EXPECT_FALSE(Of(status, "Degraded").holds);
}

TEST(WorldStatus, PhasesFollowTheRegions) {
  const struct {
    const char* phase;
    const char* of_region;
    std::function<void(RunStatus*)> change;  // of region 1, if of any
  } cases[] = {
      {"Running", "Running", [](RunStatus*) {}},
      {"Starting", "Starting",
       [](RunStatus* run) {
         run->stage = Stage::kJoining;
         run->start_unix_us = 0;
         run->regions[1] = {};
       }},
      {"Starting", "Loading",
       [](RunStatus* run) {
         run->stage = Stage::kLoading;
         run->start_unix_us = 0;
         run->regions[1].ready = run->regions[1].was_ready = false;
       }},
      {"Recovering", "Recovering", [](RunStatus* run) { run->regions[1].left = true; }},
      {"Recovering", "Recovering", [](RunStatus* run) { run->regions[1].ready = false; }},
      {"Recovering", "Recovering", [](RunStatus* run) { run->regions[1].report.set_replaying(true); }},
      {"Running", "Finished", [](RunStatus* run) { run->regions[1].finished = run->regions[1].left = true; }},
      {"Finished", "Finished",
       [](RunStatus* run) {
         run->stage = Stage::kFinished;
         run->regions[1].finished = true;
       }},
  };
  for (const auto& tested : cases) {
    RunStatus run = Running();
    tested.change(&run);
    const WorldStatus status = StatusOf(World(), run, {{0, Pod(0)}, {1, Pod(1)}});
    EXPECT_EQ(status.fields["phase"], tested.phase);
    EXPECT_EQ(status.fields["regions"][1]["phase"], tested.of_region);
    EXPECT_EQ(Of(status, "Ready").holds, std::string(tested.phase) == "Running");
  }
}

TEST(WorldStatus, SaysWhyARegionIsMissing) {
  RunStatus run = Running();
  run.regions[1].left = true;
  PodView pod = Pod(1);
  pod.started = false;
  pod.waits = "cannot be scheduled: 0/2 nodes are available.";
  const WorldStatus status = StatusOf(World(), run, {{0, Pod(0)}, {1, pod}});
  EXPECT_EQ(status.fields["regionsReady"], "1/2");
  EXPECT_EQ(status.fields["regions"][1]["phase"], "Pending");
  EXPECT_EQ(status.fields["regions"][1]["message"], pod.waits);
  EXPECT_TRUE(absl::StrContains(Of(status, "Ready").message, "region 1: cannot be scheduled"));
  EXPECT_TRUE(Of(status, "Degraded").holds);
  EXPECT_EQ(Of(status, "Degraded").reason, "RegionMissing");
}

TEST(WorldStatus, ViolationsAndLostCheckpointsAreConditions) {
  RunStatus run = Running();
  run.regions[0].report.set_violations(3);
  run.regions[1].report.set_storage_failure("disk full");
  const WorldStatus status = StatusOf(World(), run, {});
  EXPECT_FALSE(Of(status, "Exact").holds);
  EXPECT_TRUE(absl::StartsWith(Of(status, "Exact").message, "3 times"));
  EXPECT_EQ(Of(status, "Degraded").reason, "NotProtected");
  EXPECT_TRUE(absl::StrContains(Of(status, "Degraded").message, "region 1 is not protected by checkpoints: disk full"));
}

TEST(ConditionList, KeepsTheTimeOfTheLastTransition) {
  WorldStatus status;
  status.generation = 2;
  status.conditions = {{"Ready", true, "Running", ""}, {"Exact", true, "NoViolations", ""}};
  Json list = ConditionList(nullptr, status, "t1");
  const Json ready = {{"type", "Ready"}, {"status", "True"},        {"reason", "Running"},
                      {"message", ""},   {"observedGeneration", 2}, {"lastTransitionTime", "t1"}};
  ASSERT_EQ(list.size(), 2u);
  EXPECT_EQ(list[0], ready);
  status.conditions = {{"Ready", true, "Running", "more"}};
  list = ConditionList(list, status, "t2");
  EXPECT_EQ(list.size(), 2u);
  EXPECT_EQ(list[0]["message"], "more");
  EXPECT_EQ(list[0]["lastTransitionTime"], "t1");
  status.conditions = {{"Ready", false, "Recovering", ""}};
  list = ConditionList(list, status, "t3");
  EXPECT_EQ(list[0]["lastTransitionTime"], "t3");
  EXPECT_EQ(list[1]["lastTransitionTime"], "t1");
}

TEST(WorldStatus, OfAWorldThatDoesNotRunSaysWhy) {
  const WorldStatus status = StoppedStatus(3, "Pending", "Refused", "spec.storage: missing");
  EXPECT_EQ(status.fields, (Json{{"phase", "Pending"}}));
  EXPECT_EQ(Of(status, "Ready").reason, "Refused");
  EXPECT_EQ(Of(status, "Ready").message, "spec.storage: missing");
  EXPECT_TRUE(Applied("").holds);
  EXPECT_FALSE(Applied("spec.storage: cannot change").holds);
}

}  // namespace
}  // namespace aureole::kubernetes
