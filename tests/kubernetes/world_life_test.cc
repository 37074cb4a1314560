// Worlds in a fake cluster with real control planes and region servers. Whatever happens to Pods, nodes, leaders and
// the API server, the world ends bit for bit as one that nothing happened to. The faults of single requests:
// world_fault_test.cc.
#include <gtest/gtest.h>

#include <grpcpp/grpcpp.h>
#include <signal.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <iterator>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>

#include "aureole/v1/control_plane.grpc.pb.h"
#include "server/control/certificates.h"
#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/pod.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/world_file.h"
#include "server/transport/health_check.h"
#include "server/transport/security.h"
#include "tests/kubernetes/world_life.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using Clock = std::chrono::steady_clock;

TEST_F(WorldLife, RunsToItsEndAndSaysSo) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(50));
  EXPECT_EQ(TextAt(Status(), {"regionsReady"}), "2/2");
  EXPECT_EQ(Condition("Ready", "status"), "True");
  EXPECT_EQ(Condition("Applied", "status"), "True");
  EXPECT_GT(IntegerAt(Status(), {"bodies"}), 200);
  EXPECT_EQ(TextAt(Status()["regions"][1], {"pod"}), "w-r1-i1");
  EXPECT_FALSE(TextAt(Status()["regions"][1], {"node"}).empty());
  const std::string ip = TextAt(*cluster_.api().At(absl::StrCat(kPods, "control-0")), {"status", "podIP"});
  EXPECT_TRUE(CheckHealth(ip + ":7100").ok());
  const auto metrics = httplib::Client(ip, 9100).Get("/metrics");
  ASSERT_TRUE(metrics);
  for (const char* line : {"aureole_control_leader 1\n", "aureole_control_epoch 1\n", "aureole_control_worlds 1\n"}) {
    EXPECT_TRUE(absl::StrContains(metrics->body, line)) << line;
  }
  ExpectEndAsUndisturbed();
  EXPECT_TRUE(Await([&] { return cluster_.Pods("w").empty(); }));
  EXPECT_TRUE(Await([&] { return HasEvent("Running") && HasEvent("Finished"); }));
}

TEST_F(WorldLife, RegionsRunOnDifferentNodesThoughTheyAreNeighbours) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(10));
  EXPECT_NE(TextAt(Status()["regions"][0], {"node"}), TextAt(Status()["regions"][1], {"node"}));
}

// A node that is drained, or a restart of all: each region leaves to another one, and no server repeats anything.
TEST_F(WorldLife, RegionsOfDeletedPodsLeaveInOrder) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(60));
  ApiClient people(cluster_.api().Access());
  for (const char* pod : {"w-r0-i1", "w-r1-i1"}) {
    ASSERT_TRUE(people.Delete({"", "v1", "pods", "test"}, pod).ok());
  }
  ASSERT_TRUE(Await([&] {
    return cluster_.ProcessOf("w-r0-i1") < 0 && cluster_.ProcessOf("w-r1-i1") < 0 &&
           TextAt(Status(), {"regionsReady"}) == "2/2";
  }));
  EXPECT_GT(cluster_.ProcessOf("w-r2-i1"), 0);
  EXPECT_GT(cluster_.ProcessOf("w-r3-i1"), 0);
  EXPECT_FALSE(HasEvent("RegionReplaced"));
  ExpectEndAsUndisturbed();
  EXPECT_TRUE(Await([&] { return HasEvent("RegionLeaves"); }));
}

TEST_F(WorldLife, RegionOfADeletedPodThatFallsSilentIsReplaced) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(100));
  const pid_t old = cluster_.ProcessOf("w-r1-i1");
  kill(old, SIGSTOP);
  ApiClient people(cluster_.api().Access());
  ASSERT_TRUE(people.Delete({"", "v1", "pods", "test"}, "w-r1-i1").ok());
  ASSERT_TRUE(Await([&] { return Incarnation(1) == 2; }));
  kill(old, SIGKILL);
  EXPECT_EQ(Incarnation(0), 1u);
  ExpectEndAsUndisturbed();
  EXPECT_TRUE(Await([&] { return HasEvent("RegionReplaced"); }));
}

TEST_F(WorldLife, KilledServerIsReplaced) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(100));
  ASSERT_EQ(kill(cluster_.ProcessOf("w-r0-i1"), SIGKILL), 0);
  ASSERT_TRUE(Await([&] { return Incarnation(0) == 2; }));
  ExpectEndAsUndisturbed();
}

// The worst case: the node's processes go on, and nobody can end them.
TEST_F(WorldLife, LostNodeIsFencedAndItsRegionsRunElsewhere) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(100));
  const std::string node = TextAt(Status()["regions"][0], {"node"});
  const pid_t old = cluster_.ProcessOf("w-r0-i1");
  cluster_.LoseNode(node, /*processes_go_on=*/true);
  ApiClient controllers(cluster_.api().Access());  // as the node controller does after a while
  ASSERT_TRUE(controllers.Delete({"", "v1", "pods", "test"}, "w-r0-i1").ok());
  kill(old, SIGSTOP);  // nothing is heard of it
  ASSERT_TRUE(Await([&] { return Incarnation(0) >= 2; }));
  kill(old, SIGCONT);
  ASSERT_TRUE(Await([&] { return TextAt(Status()["regions"][0], {"node"}) != node; }));
  ASSERT_TRUE(Await([&] { return Phase() == "Finished"; })) << Phase() << " at tick " << Tick();
  EXPECT_EQ(TextAt(Status(), {"hash", "hash"}), HashOfTheEnd(seconds_));
}

// The scheduler finds it as good as any, as it runs less than the others.
TEST_F(WorldLife, DeadNodeThatTheClusterDoesNotKnowOfGetsNoReplacement) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(100));
  const std::string node = TextAt(Status()["regions"][0], {"node"});
  cluster_.LoseNode(node, /*processes_go_on=*/false, /*cluster_knows=*/false);
  ASSERT_TRUE(Await([&] { return Incarnation(0) >= 2; }));
  ASSERT_TRUE(Await([&] { return Phase() == "Finished"; }, seconds(30))) << Phase() << " at tick " << Tick();
  EXPECT_EQ(TextAt(Status(), {"hash", "hash"}), HashOfTheEnd(seconds_));
  EXPECT_EQ(Incarnation(0), 2u);
}

TEST_F(WorldLife, OnTheOnlyNodeALostServerIsReplacedThere) {
  cluster_.LoseNode("n2", false);
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(100));
  kill(cluster_.ProcessOf("w-r0-i1"), SIGSTOP);
  ASSERT_TRUE(Await([&] { return Incarnation(0) >= 2; }));
  ExpectEndAsUndisturbed();
  EXPECT_EQ(Incarnation(0), 3u) << "there was no other place for the second";
}

TEST_F(WorldLife, NextLeaderTakesOverWhatRuns) {
  cluster_.StartControl(0);
  ASSERT_TRUE(Await([&] { return cluster_.Leader() == 0; }));
  cluster_.StartControl(1);
  const std::string standby = TextAt(*cluster_.api().At(absl::StrCat(kPods, "control-1")), {"status", "podIP"});
  EXPECT_TRUE(Await([&] { return CheckHealth(standby + ":7100").ok(); })) << "it is as ready as the leader";
  Create(Spec());
  ASSERT_TRUE(AwaitTick(20));
  const pid_t servers[] = {cluster_.ProcessOf("w-r0-i1"), cluster_.ProcessOf("w-r1-i1")};
  cluster_.SignalControl(0, SIGKILL);
  ASSERT_TRUE(Await([&] { return cluster_.Leader() == 1; }));
  ASSERT_TRUE(Await([&] { return IntegerAt(Status(), {"controlEpoch"}).value_or(0) == 2; }));
  const int64_t tick = Tick();
  ASSERT_TRUE(Await([&] { return Tick() > tick && TextAt(Status(), {"regionsReady"}) == "2/2"; }));
  EXPECT_EQ(kill(servers[0], 0), 0);
  EXPECT_EQ(kill(servers[1], 0), 0);
  EXPECT_EQ(Incarnation(0), 1u);
  EXPECT_EQ(Incarnation(1), 1u);
  ExpectEndAsUndisturbed();
}

TEST_F(WorldLife, LeaderThatIsToldToEndHandsOverAtOnce) {
  cluster_.StartControl(0);
  ASSERT_TRUE(Await([&] { return cluster_.Leader() == 0; }));
  cluster_.StartControl(1);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(50));
  cluster_.SignalControl(0, SIGTERM);
  const auto told = Clock::now();
  ASSERT_TRUE(Await([&] { return cluster_.Leader() == 1; }));
  EXPECT_LT(Clock::now() - told, seconds(3)) << "the lease had to run out";
  EXPECT_TRUE(Await([&] { return !cluster_.ControlRuns(0); }));
  ExpectEndAsUndisturbed();
  EXPECT_EQ(Incarnation(0), 1u);
  EXPECT_EQ(Incarnation(1), 1u);
}

TEST_F(WorldLife, ServerThatDiesWithTheLeaderIsReplacedByTheNext) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(100));
  cluster_.SignalControl(0, SIGKILL);
  kill(cluster_.ProcessOf("w-r1-i1"), SIGKILL);
  cluster_.StartControl(1);
  ASSERT_TRUE(Await([&] { return Incarnation(1) == 2; }));
  ExpectEndAsUndisturbed();
  EXPECT_EQ(Incarnation(0), 1u);
}

TEST_F(WorldLife, KeepsTheImageThatItBeganWithWhenTheControlPlaneIsUpgraded) {
  const auto image = [this](const char* pod) {
    const auto found = cluster_.api().At(absl::StrCat(kPods, pod));
    return found ? TextAt((*found)["spec"]["containers"][0], {"image"}) : "no such Pod";
  };
  seconds_ = 16;  // so that a slow machine gets there before the end
  cluster_.StartControl(0, {}, "aureole:1");
  Create(Spec());
  ASSERT_TRUE(AwaitTick(20));
  EXPECT_EQ(image("w-r1-i1"), "aureole:1");
  cluster_.SignalControl(0, SIGKILL);
  cluster_.StartControl(1, {}, "aureole:2");
  ASSERT_TRUE(Await([&] { return IntegerAt(Status(), {"controlEpoch"}).value_or(0) == 2; }));
  kill(cluster_.ProcessOf("w-r1-i1"), SIGKILL);
  ASSERT_TRUE(Await([&] { return Incarnation(1) == 2; }));
  EXPECT_EQ(image("w-r1-i2"), "aureole:1") << "region 0 runs it still";
  ExpectEndAsUndisturbed();
}

TEST_F(WorldLife, GoesOnWhileTheApiServerIsAway) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(100));
  cluster_.api().Stop();
  // Longer than the lease: the leader ends, the servers do not.
  ASSERT_TRUE(Await([&] { return !cluster_.ControlRuns(0); }));
  cluster_.api().Start();
  cluster_.StartControl(1);
  ExpectEndAsUndisturbed();
  EXPECT_EQ(Incarnation(0), 1u);
}

TEST_F(WorldLife, DeletedWorldStopsInOrder) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(50));
  cluster_.api().Remove(absl::StrCat(kWorlds, "w"));
  EXPECT_TRUE(Await([&] { return cluster_.processes() == 0 && cluster_.Pods("w").empty(); }));
  // A new one of the same name has nothing of the old one.
  Create(Spec());
  ASSERT_TRUE(AwaitTick(50));
}

TEST_F(WorldLife, WorldThatIsDeletedWhileNobodyLeadsLeavesNothing) {
  constexpr char kSpace[] = "/api/v1/namespaces/test/";
  const std::string claims = absl::StrCat(kSpace, "persistentvolumeclaims");
  cluster_.StartControl(0);
  Json spec = Spec();
  spec["storage"] = {{"volumeClaim", {{"size", "1Gi"}}}};
  spec["duration"] = "1000s";
  Create(spec);
  ASSERT_TRUE(AwaitTick(50));
  EXPECT_EQ(cluster_.api().All(claims).size(), 2u);
  cluster_.SignalControl(0, SIGKILL);
  ASSERT_TRUE(Await([&] { return !cluster_.ControlRuns(0); }));
  // Whatever it made for the World is the World's, but for events, which go after an hour.
  int made = cluster_.api().Count("POST /apis/coordination.k8s.io/v1/namespaces/test/leases");
  for (const char* kind : {"pods", "persistentvolumeclaims", "events"}) {
    made += cluster_.api().Count(absl::StrCat("POST ", kSpace, kind));
  }
  EXPECT_EQ(cluster_.api().Count("POST "), made);
  cluster_.api().Remove(absl::StrCat(kWorlds, "w"));
  // Long before they would be killed: told to end, a server ends.
  EXPECT_TRUE(Await([&] { return cluster_.processes() == 0; }, seconds(15)));
  EXPECT_TRUE(Await([&] { return cluster_.Pods("w").empty() && cluster_.api().All(claims).empty(); }));
}

TEST_F(WorldLife, RefusedWorldSaysWhyAndRunsOnceItIsRight) {
  cluster_.StartControl(0);
  Json spec = Spec();
  spec["world"]["bodys"] = Json::array();
  Create(spec);
  ASSERT_TRUE(Await([&] { return Phase() == "Pending"; }));
  EXPECT_EQ(Condition("Ready", "reason"), "Refused");
  EXPECT_TRUE(absl::StartsWith(Condition("Ready", "message"), "spec.world.bodys: there is no such field"));
  EXPECT_TRUE(cluster_.Pods("w").empty());
  EXPECT_TRUE(Await([&] { return HasEvent("Refused"); }));
  cluster_.api().Merge(absl::StrCat(kWorlds, "w"), {{"spec", {{"world", {{"bodys", nullptr}}}}}});
  ASSERT_TRUE(AwaitTick(10));
}

TEST_F(WorldLife, RunThatFailedIsToldAndTriedAgain) {
  cluster_.StartControl(0);
  cluster_.api().Inject({.kind = Fault::Kind::kStatus,
                         .method = "POST",
                         .target = "/pods",
                         .times = 11,  // six in a row of one of the two regions, whichever
                         .status = 403,
                         .reason = "Forbidden"});
  Create(Spec());
  ASSERT_TRUE(Await([&] { return Phase() == "Failed"; }));
  EXPECT_EQ(Condition("Ready", "reason"), "RunFailed");
  EXPECT_TRUE(absl::StrContains(Condition("Ready", "message"), "its Pod cannot be made: POST"))
      << Condition("Ready", "message");
  cluster_.api().Merge(absl::StrCat(kWorlds, "w"), {{"spec", {{"image", "another"}}}});  // does not wait for its time
  ExpectEndAsUndisturbed();
}

TEST_F(WorldLife, RefusedStatusIsToldOfAndTheWorldGoesOn) {
  cluster_.api().Inject({.method = "PATCH",
                         .target = "/worlds/w/status",
                         .times = 3,
                         .status = 422,
                         .body = "regionsReady",
                         .message = "World \"w\" is invalid: status.regionsReady: Invalid value"});
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(Await([&] { return HasEvent("StatusRefused"); }));
  const std::vector<Json> events = cluster_.api().All("/api/v1/namespaces/test/events");
  EXPECT_TRUE(std::any_of(events.begin(), events.end(), [](const Json& event) {
    return absl::StrContains(TextAt(event, {"message"}), "status.regionsReady: Invalid value");
  }));
  EXPECT_TRUE(absl::StrContains(cluster_.Logs(), "[control] world w: its status is refused: PATCH"));
  ASSERT_TRUE(Await([&] { return cluster_.processes() == 2; })) << "the record was written";
  ExpectEndAsUndisturbed();
}

// It was about to remove the Pods.
TEST_F(WorldLife, WhatALeaderLeftOfAFinishedWorldGoes) {
  Create(Spec());
  PodTemplate pods;
  pods.world = "w";
  pods.space = "test";
  pods.uid = TextAt(cluster_.World("w"), {"metadata", "uid"});
  cluster_.api().Merge(absl::StrCat(kWorlds, "w"), {{"status", {{"phase", "Finished"}}}});
  cluster_.LoseNode("n1", false);
  cluster_.LoseNode("n2", false);
  cluster_.api().Put(absl::StrCat(kPods, "w-r0-i1"), PodManifest(pods, {0, 1, "t", "127.0.0.1:1"}));
  cluster_.StartControl(0);
  EXPECT_TRUE(Await([&] { return cluster_.Pods("w").empty(); }));
  for (const int seed : {2, 3}) {  // too late; the second is read after the first was dealt with
    const auto reads = [this] {
      return cluster_.api().Count("GET /apis/aureole.dev/v1alpha1/namespaces/test/worlds/w");
    };
    const int before = reads();
    cluster_.api().Merge(absl::StrCat(kWorlds, "w"), {{"spec", {{"world", {{"seed", seed}}}}}});
    EXPECT_TRUE(Await([&] { return reads() > before; }));
  }
  EXPECT_EQ(Phase(), "Finished");
}

TEST_F(WorldLife, ChangeThatCannotBeIsSaidAndTheRunGoesOn) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(50));
  cluster_.api().Merge(absl::StrCat(kWorlds, "w"), {{"spec", {{"duration", "1000s"}, {"image", "newer"}}}});
  ASSERT_TRUE(Await([&] { return Condition("Applied", "status") == "False"; }));
  EXPECT_TRUE(absl::StartsWith(Condition("Applied", "message"), "spec.duration: cannot change"));
  kill(cluster_.ProcessOf("w-r0-i1"), SIGKILL);
  ASSERT_TRUE(Await([&] { return Incarnation(0) == 2; }));
  const auto next = cluster_.api().At(absl::StrCat(kPods, "w-r0-i2"));
  ASSERT_TRUE(next);
  EXPECT_EQ((*next)["spec"]["containers"][0]["image"], "newer") << "the operator's word";
  // The next control plane knows what has begun, too.
  cluster_.SignalControl(0, SIGKILL);
  cluster_.StartControl(1);
  ExpectEndAsUndisturbed();
}

TEST_F(WorldLife, OperatorsReachTheirWorldByName) {
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(50));
  const auto stub = v1::ControlPlane::NewStub(
      grpc::CreateChannel(absl::StrCat(cluster_.service(), ":7100"), grpc::InsecureChannelCredentials()));
  const auto context = [](const std::string& world) {
    auto out = std::make_unique<grpc::ClientContext>();
    out->set_deadline(std::chrono::system_clock::now() + seconds(20));
    out->AddMetadata("aureole-world", world);
    return out;
  };
  v1::ControlledWorld world;
  grpc::Status s = stub->GetWorld(context("other").get(), {}, &world);
  EXPECT_EQ(s.error_code(), grpc::StatusCode::NOT_FOUND);
  EXPECT_TRUE(absl::EndsWith(s.error_message(), "here run: w")) << s.error_message();
  s = stub->GetWorld(context("w").get(), {}, &world);
  EXPECT_TRUE(s.ok()) << s.error_message();
  EXPECT_EQ(world.regions_size(), 2);
  v1::DrainRegionRequest drain;
  drain.set_region(1);
  v1::DrainRegionResponse drained;
  s = stub->DrainRegion(context("w").get(), drain, &drained);
  EXPECT_TRUE(s.ok()) << s.error_message();
  const auto call = context("w");
  v1::WatchEventsRequest request;
  request.set_follow(true);
  const auto stream = stub->WatchEvents(call.get(), request);
  v1::ControlEvent event;
  bool left = false;
  while (!left && stream->Read(&event)) left = event.kind() == v1::ControlEvent::REGION_LEFT && event.region() == 1;
  EXPECT_TRUE(left);
  call->TryCancel();
  stream->Finish();
  ExpectEndAsUndisturbed();
}

TEST_F(WorldLife, WorldsOfOneControlPlaneDoNotMix) {
  cluster_.StartControl(0);
  Json spec = Spec();
  cluster_.api().Put("/api/v1/namespaces/test/configmaps/files", {{"data", {{"pile.json", FileText()}}}});
  spec.erase("world");
  spec["worldFrom"] = {{"configMap", "files"}, {"key", "pile.json"}};
  Create(spec);
  spec["realTime"] = false;
  cluster_.api().Put(absl::StrCat(kWorlds, "v"), {{"kind", "World"}, {"spec", spec}});
  ExpectEndAsUndisturbed();
  ASSERT_TRUE(Await([&] { return TextAt(cluster_.World("v"), {"status", "phase"}) == "Finished"; }));
  EXPECT_EQ(TextAt(cluster_.World("v"), {"status", "hash", "hash"}), TextAt(Status(), {"hash", "hash"}));
}

TEST_F(WorldLife, ServersAndControlPlanesShowEachOtherTheirCertificates) {
  const std::string tls = cluster_.disk() + "/tls";
  std::filesystem::create_directories(tls);
  ASSERT_TRUE(WriteCertificates(tls, {}, absl::Hours(1)).ok());
  cluster_.StartControl(0, {"--tls", tls});
  Create(Spec());
  ASSERT_TRUE(AwaitTick(50));
  const std::string ip = TextAt(*cluster_.api().At(absl::StrCat(kPods, "control-0")), {"status", "podIP"});
  EXPECT_FALSE(CheckHealth(ip + ":7100").ok()) << "in plain text";
  SecurityOptions security;
  security.tls = tls;
  EXPECT_TRUE(CheckHealth(ip + ":7100", (*Security::Open(security))->channel()).ok());
  kill(cluster_.ProcessOf("w-r1-i1"), SIGKILL);
  ASSERT_TRUE(Await([&] { return Incarnation(1) == 2; }));
  ExpectEndAsUndisturbed();
}

}  // namespace
}  // namespace aureole::kubernetes
