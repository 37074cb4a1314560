// Servers as Pods: each is made once, its end is told once, with what Kubernetes says, whatever happens to the API
// server. The faults, by kAllFaults:
//
//   of the request that makes a Pod: 429 with and without Retry-After, 500, 503, a conflict, a reply that is lost, cut
//     or late, none at all, an expired token
//   of the watch: cut between and within events, 410 by HTTP status and by ERROR event, garbage, silence, 500
//   and refusals, which are ends: 403, 422
#include "server/control/kubernetes/pod_allocator.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>

#include "tests/kubernetes/await.h"
#include "tests/kubernetes/fake_api_server.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;
using Kind = Fault::Kind;

constexpr char kPods[] = "/api/v1/namespaces/test/pods";

const Json kRunning = {{"spec", {{"nodeName", "n1"}}},
                       {"status",
                        {{"phase", "Running"},
                         {"podIP", "10.0.0.9"},
                         {"containerStatuses", Json::array({{{"state", {{"running", Json::object()}}}}})}}}};

Json Exited(int code, const std::string& reason) {
  return {{"status",
           {{"phase", code == 0 ? "Succeeded" : "Failed"},
            {"containerStatuses",
             Json::array({{{"state", {{"terminated", {{"exitCode", code}, {"reason", reason}}}}}}})}}}};
}

PodAllocator::Options TestOptions() {
  PodAllocator::Options options;
  options.pods.world = "w";
  options.pods.space = "test";
  options.pods.uid = "world-uid";
  options.pods.image = "image";
  options.first_pause = milliseconds(5);
  options.longest_pause = milliseconds(100);
  options.leave_margin = milliseconds(100);
  options.kill_patience = milliseconds(300);
  return options;
}

ServerStart StartOf(RegionId region, uint64_t incarnation) {
  return {region, incarnation, absl::StrCat("token-", region, "-", incarnation), "10.0.0.1:7100"};
}

class PodAllocatorTest : public testing::Test {
 protected:
  void Open(PodAllocator::Options options = TestOptions()) {
    allocator_.reset();
    allocator_ = std::make_unique<PodAllocator>(&client_, std::move(options));
  }
  static std::string PathOf(RegionId region, uint64_t incarnation) {
    return absl::StrCat(kPods, "/", PodName("w", region, incarnation));
  }
  bool AwaitPod(RegionId region, uint64_t incarnation) {
    return Await([&] { return server_.At(PathOf(region, incarnation)).has_value(); });
  }
  void Run(RegionId region, uint64_t incarnation) {
    ASSERT_TRUE(allocator_->Start(StartOf(region, incarnation)).ok());
    ASSERT_TRUE(AwaitPod(region, incarnation));
    server_.Merge(PathOf(region, incarnation), kRunning);
  }
  // The next one; a made-up one of no region when none comes.
  ServerExit AwaitExit() {
    Await([&] {
      for (ServerExit& exit : allocator_->Poll()) exits_.push_back(std::move(exit));
      return !exits_.empty();
    });
    if (exits_.empty()) return {};
    ServerExit exit = exits_.front();
    exits_.erase(exits_.begin());
    return exit;
  }

  FakeApiServer server_;
  ApiClient client_{server_.Access()};
  std::vector<ServerExit> exits_;
  std::unique_ptr<PodAllocator> allocator_;
};

TEST_F(PodAllocatorTest, ServerIsAPodUntilItEnds) {
  Open();
  Run(0, 1);
  Run(1, 1);
  EXPECT_EQ(allocator_->running(), 2);
  server_.PutLog(PathOf(1, 1), "one\ntwo\n");
  server_.Merge(PathOf(1, 1), Exited(137, "OOMKilled"));
  const ServerExit exit = AwaitExit();
  EXPECT_EQ(exit.region, 1);
  EXPECT_EQ(exit.incarnation, 1u);
  EXPECT_FALSE(exit.clean);
  EXPECT_EQ(exit.how, "exit status 137 (OOMKilled)");
  EXPECT_EQ(exit.log, "kubectl logs -n test w-r1-i1");
  EXPECT_EQ(exit.log_tail, "one\ntwo");
  EXPECT_EQ(allocator_->running(), 1);
  server_.Merge(PathOf(0, 1), Exited(0, "Completed"));
  EXPECT_TRUE(AwaitExit().clean);
  EXPECT_EQ(allocator_->running(), 0);
  EXPECT_TRUE(allocator_->Poll().empty());
}

TEST_F(PodAllocatorTest, DeletedPodIsAnEnd) {
  Open();
  Run(0, 1);
  ASSERT_TRUE(Await([&] { return allocator_->Newest()[0].started; }));
  server_.Remove(PathOf(0, 1));
  EXPECT_EQ(AwaitExit().how, "deleted");
}

TEST_F(PodAllocatorTest, EvictedPodIsAnEnd) {
  Open();
  Run(0, 1);
  server_.Merge(PathOf(0, 1), {{"status", {{"phase", "Failed"}, {"reason", "Evicted"}, {"message", "low on memory"}}}});
  EXPECT_EQ(AwaitExit().how, "Evicted: low on memory");
}

TEST_F(PodAllocatorTest, NodeThatDoesNotConfirmADeletionIsLost) {
  Open();
  Run(0, 1);
  server_.Merge(PathOf(0, 1),
                {{"metadata", {{"deletionTimestamp", "2026-01-01T00:00:00Z"}, {"deletionGracePeriodSeconds", 0}}}});
  EXPECT_EQ(AwaitExit().how, "node lost: n1 does not say that the deleted Pod has ended");
  EXPECT_EQ(server_.Count("DELETE"), 0);
}

TEST_F(PodAllocatorTest, PodThatCannotBeScheduledIsAnEndAfterAWhile) {
  PodAllocator::Options options = TestOptions();
  options.start_patience = milliseconds(300);
  Open(options);
  ASSERT_TRUE(allocator_->Start(StartOf(0, 1)).ok());
  ASSERT_TRUE(AwaitPod(0, 1));
  server_.Merge(
      PathOf(0, 1),
      {{"status",
        {{"phase", "Pending"},
         {"conditions",
          Json::array({{{"type", "PodScheduled"}, {"status", "False"}, {"message", "0/2 nodes are available."}}})}}}});
  ASSERT_TRUE(Await([&] { return allocator_->Newest()[0].waits == "cannot be scheduled: 0/2 nodes are available."; }));
  EXPECT_EQ(AwaitExit().how, "cannot be scheduled: 0/2 nodes are available.");
  EXPECT_TRUE(Await([&] { return !server_.At(PathOf(0, 1)); }));
}

Json Avoided(const Json& pod) {
  Json nodes = Json::array();
  const Json* const terms = Find(
      pod, {"spec", "affinity", "nodeAffinity", "requiredDuringSchedulingIgnoredDuringExecution", "nodeSelectorTerms"});
  if (terms == nullptr) return nodes;
  for (const Json& field : terms->front()["matchFields"]) nodes.push_back(field["values"][0]);
  return nodes;
}

TEST_F(PodAllocatorTest, PodsAvoidTheNodeOfALostServerForAWhile) {
  PodAllocator::Options options = TestOptions();
  options.avoid_for = milliseconds(500);
  Open(options);
  Run(0, 1);
  Run(1, 1);
  server_.Merge(PathOf(1, 1), {{"spec", {{"nodeName", "n2"}}}});
  ASSERT_TRUE(Await([&] { return allocator_->Newest()[0].started && allocator_->Newest()[1].node == "n2"; }));
  server_.Merge(PathOf(1, 1), Exited(1, "Error"));
  EXPECT_EQ(AwaitExit().region, 1);
  Run(1, 2);
  EXPECT_EQ(Avoided(*server_.At(PathOf(1, 2))), Json::array()) << "n2 has said that it ended";
  allocator_->End(0, 1);
  Run(0, 2);
  Run(1, 3);
  EXPECT_EQ(Avoided(*server_.At(PathOf(0, 2))), Json({"n1"}));
  EXPECT_EQ(Avoided(*server_.At(PathOf(1, 3))), Json({"n1"})) << "whichever region";
  std::this_thread::sleep_for(options.avoid_for);
  Run(0, 3);
  EXPECT_EQ(Avoided(*server_.At(PathOf(0, 3))), Json::array());
}

const Json kBoundOnly = {
    {"spec", {{"nodeName", "n1"}}},
    {"status", {{"phase", "Pending"}, {"conditions", Json::array({{{"type", "PodScheduled"}, {"status", "True"}}})}}}};

TEST_F(PodAllocatorTest, PodThatItsNodeDoesNotTakeIsForgottenAndTheNodeAvoided) {
  PodAllocator::Options options = TestOptions();
  options.take_patience = milliseconds(300);
  Open(options);
  for (const int region : {0, 1}) {
    ASSERT_TRUE(allocator_->Start(StartOf(region, 1)).ok());
    ASSERT_TRUE(AwaitPod(region, 1));
  }
  Json taken = kBoundOnly;
  taken["status"]["startTime"] = "2026-01-01T00:00:00Z";  // it pulls the image, say
  server_.Merge(PathOf(1, 1), taken);
  server_.Merge(PathOf(0, 1), kBoundOnly);
  const ServerExit exit = AwaitExit();
  EXPECT_EQ(exit.region, 0);
  EXPECT_EQ(exit.how, "node lost: n1 has not taken note of its Pod within 0.3 s");
  EXPECT_TRUE(Await([&] { return !server_.At(PathOf(0, 1)); })) << "it waits for the node";
  ASSERT_TRUE(allocator_->Start(StartOf(0, 2)).ok());
  ASSERT_TRUE(AwaitPod(0, 2));
  EXPECT_EQ(Avoided(*server_.At(PathOf(0, 2))), Json({"n1"}));
  EXPECT_TRUE(allocator_->Poll().empty());
  EXPECT_EQ(allocator_->running(), 2);
}

TEST_F(PodAllocatorTest, WhatHasNoOtherPlaceMayRunOnAnAvoidedNode) {
  PodAllocator::Options options = TestOptions();
  options.take_patience = options.avoid_patience = milliseconds(300);
  options.start_patience = milliseconds(2000);
  Open(options);
  Run(0, 1);
  ASSERT_TRUE(Await([&] { return allocator_->Newest()[0].started; }));
  allocator_->End(0, 1);
  AwaitExit();
  ASSERT_TRUE(allocator_->Start(StartOf(0, 2)).ok());
  ASSERT_TRUE(AwaitPod(0, 2));
  EXPECT_EQ(Avoided(*server_.At(PathOf(0, 2))), Json({"n1"}));
  const Json condition = {{"type", "PodScheduled"}, {"status", "False"}, {"message", "0/1 nodes are available."}};
  server_.Merge(PathOf(0, 2), {{"status", {{"phase", "Pending"}, {"conditions", Json::array({condition})}}}});
  EXPECT_EQ(AwaitExit().how, "cannot be scheduled: 0/1 nodes are available.; the next one may run where one was lost");
  EXPECT_TRUE(Await([&] { return !server_.At(PathOf(0, 2)); }));
  ASSERT_TRUE(allocator_->Start(StartOf(0, 3)).ok());
  ASSERT_TRUE(AwaitPod(0, 3));
  EXPECT_EQ(Avoided(*server_.At(PathOf(0, 3))), Json::array());
  server_.Merge(PathOf(0, 3), kBoundOnly);
  EXPECT_EQ(AwaitExit().how, "has not started within 2 s") << "there is no use in trying again and again";
}

TEST_F(PodAllocatorTest, EndIsToldAtOnceWhateverItsNodeDoes) {
  Open();
  Run(0, 1);
  server_.Inject({.kind = Kind::kHang, .method = "DELETE"});
  allocator_->End(0, 1);
  const std::vector<ServerExit> exits = allocator_->Poll();
  ASSERT_EQ(exits.size(), 1u);
  EXPECT_EQ(exits[0].how, "killed: its Pod is deleted");
  EXPECT_EQ(allocator_->running(), 0);
  server_.Release();
  EXPECT_TRUE(Await([&] { return server_.At(PathOf(0, 1)).value()["metadata"].contains("deletionTimestamp"); }));
  EXPECT_EQ(server_.At(PathOf(0, 1)).value()["metadata"]["deletionGracePeriodSeconds"], 1);
  allocator_->End(0, 1);
  allocator_->End(5, 1);
  EXPECT_TRUE(allocator_->Poll().empty());
  // The old one is there still, its node says nothing: the next one does not wait for it.
  Run(0, 2);
  EXPECT_EQ(allocator_->running(), 1);
}

TEST_F(PodAllocatorTest, EndedPodStaysForItsLogUntilTheNextOneRuns) {
  Open();
  Run(0, 1);
  server_.Merge(PathOf(0, 1), Exited(1, "Error"));
  EXPECT_EQ(AwaitExit().how, "exit status 1");
  ASSERT_TRUE(allocator_->Start(StartOf(0, 2)).ok());
  ASSERT_TRUE(AwaitPod(0, 2));
  EXPECT_TRUE(server_.At(PathOf(0, 1)));
  server_.Merge(PathOf(0, 2), kRunning);
  EXPECT_TRUE(Await([&] { return !server_.At(PathOf(0, 1)) || ReadPod(*server_.At(PathOf(0, 1)))->leaving; }));
  EXPECT_FALSE(ReadPod(*server_.At(PathOf(0, 2)))->leaving);
}

TEST_F(PodAllocatorTest, NextControlPlaneAdoptsTheNewestThatRun) {
  Open();
  for (const auto& [region, incarnation] : {std::pair(0, 1), std::pair(1, 1), std::pair(1, 2), std::pair(2, 1)}) {
    Run(region, static_cast<uint64_t>(incarnation));
  }
  server_.Merge(PathOf(2, 1), Exited(1, "Error"));
  Json foreign = PodManifest({.world = "w", .space = "test", .uid = "another world of this name"}, StartOf(3, 9));
  server_.Put(PathOf(3, 9), foreign);
  allocator_->Release();
  Open();
  EXPECT_EQ(server_.Count("DELETE"), 0) << "released";
  const absl::StatusOr<std::vector<ServerStart>> adopted = allocator_->Adopt();
  ASSERT_TRUE(adopted.ok()) << adopted.status();
  ASSERT_EQ(adopted->size(), 2u);
  EXPECT_EQ((*adopted)[0].region, 0);
  EXPECT_EQ((*adopted)[0].token, "token-0-1");
  EXPECT_EQ((*adopted)[0].listen, "10.0.0.9:7000");
  EXPECT_EQ((*adopted)[1].region, 1);
  EXPECT_EQ((*adopted)[1].incarnation, 2u);
  EXPECT_EQ(allocator_->running(), 2);
  // The older one of region 1 is fenced, and goes.
  EXPECT_TRUE(Await([&] { return ReadPod(*server_.At(PathOf(1, 1)))->leaving; }));
  EXPECT_FALSE(ReadPod(*server_.At(PathOf(3, 9)))->leaving);
  server_.Merge(PathOf(0, 1), Exited(3, "Error"));
  EXPECT_EQ(AwaitExit().how, "exit status 3");
}

TEST_F(PodAllocatorTest, PodThatGoesWhileNobodyAdoptsIsAnEnd) {
  Open();
  Run(0, 1);
  allocator_->Release();
  Open();
  ASSERT_TRUE(allocator_->Adopt().ok());
  server_.Remove(PathOf(0, 1));
  EXPECT_EQ(AwaitExit().how, "deleted");
}

TEST_F(PodAllocatorTest, KillLeavesNoPodOfTheWorld) {
  Open();
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(allocator_->Start(StartOf(i, 1)).ok());
  ASSERT_TRUE(AwaitPod(0, 1));
  server_.Put(PathOf(9, 1), PodManifest(TestOptions().pods, StartOf(9, 1)));
  allocator_->Kill();
  EXPECT_TRUE(server_.All(kPods).empty());
  EXPECT_EQ(allocator_->running(), 0);
  allocator_.reset();
  EXPECT_TRUE(server_.All(kPods).empty());
}

TEST_F(PodAllocatorTest, KillDoesNotWaitForLostNodesForever) {
  PodAllocator::Options options = TestOptions();
  options.kill_patience = milliseconds(300);
  Open(options);
  Run(0, 1);
  const auto began = std::chrono::steady_clock::now();
  allocator_->Kill();
  EXPECT_GE(std::chrono::steady_clock::now() - began, milliseconds(300));
  EXPECT_LT(std::chrono::steady_clock::now() - began, std::chrono::seconds(5));
  EXPECT_TRUE(ReadPod(*server_.At(PathOf(0, 1)))->leaving);
}

TEST_F(PodAllocatorTest, WhoLeadsNoMoreChangesNothing) {
  std::atomic<bool> leads = true;
  PodAllocator::Options options = TestOptions();
  options.leads = [&leads] { return leads.load(); };
  Open(options);
  Run(0, 1);
  leads = false;
  ASSERT_TRUE(allocator_->Start(StartOf(1, 1)).ok());
  allocator_->End(0, 1);
  ASSERT_TRUE(Await([&] { return allocator_->Newest().contains(1); }));
  allocator_.reset();
  EXPECT_EQ(server_.Count("POST"), 1);
  EXPECT_EQ(server_.Count("DELETE"), 0);
}

TEST_F(PodAllocatorTest, PodOfAnotherControlPlaneIsAnEnd) {
  Open();
  server_.Put(PathOf(0, 2), PodManifest(TestOptions().pods, {0, 2, "another token", ""}));
  ASSERT_TRUE(allocator_->Start(StartOf(0, 2)).ok());
  EXPECT_EQ(AwaitExit().how, "its Pod cannot be made: w-r0-i2 is of another control plane");
}

TEST_F(PodAllocatorTest, PodOfADeletedWorldOfTheSameNameMakesRoom) {
  PodTemplate old = TestOptions().pods;
  old.uid = "deleted";
  server_.Put(PathOf(0, 1), PodManifest(old, StartOf(0, 1)));
  Open();
  ASSERT_TRUE(allocator_->Start(StartOf(0, 1)).ok());
  EXPECT_TRUE(Await([&] {
    const std::optional<Json> pod = server_.At(PathOf(0, 1));
    return pod && ReadPod(*pod)->owner == "world-uid";
  }));
}

TEST_F(PodAllocatorTest, ClaimIsMadeOnceAndStays) {
  constexpr char kClaim[] = "/api/v1/namespaces/test/persistentvolumeclaims/w-region-0";
  PodAllocator::Options options = TestOptions();
  options.pods.storage = {.kind = Storage::Kind::kVolumeClaim, .size = "1Gi"};
  Open(options);
  Run(0, 1);
  ASSERT_TRUE(server_.At(kClaim));
  const std::string uid = TextAt(*server_.At(kClaim), {"metadata", "uid"});
  allocator_->End(0, 1);
  Run(0, 2);
  allocator_->Kill();
  ASSERT_TRUE(server_.At(kClaim));
  EXPECT_EQ(TextAt(*server_.At(kClaim), {"metadata", "uid"}), uid);
}

TEST_F(PodAllocatorTest, NewTemplateIsForNewPods) {
  Open();
  Run(0, 1);
  PodTemplate pods = TestOptions().pods;
  pods.image = "newer";
  allocator_->Use(pods);
  Run(0, 2);
  EXPECT_EQ(server_.At(PathOf(0, 1)).value()["spec"]["containers"][0]["image"], "image");
  EXPECT_EQ(server_.At(PathOf(0, 2)).value()["spec"]["containers"][0]["image"], "newer");
}

TEST_F(PodAllocatorTest, RefusalIsAnEndThatSaysWhy) {
  Open();
  for (const int status : {403, 422}) {
    server_.Inject({.method = "POST", .target = "pods", .status = status});
    ASSERT_TRUE(allocator_->Start(StartOf(0, 1)).ok());
    const ServerExit exit = AwaitExit();
    EXPECT_TRUE(absl::StartsWith(exit.how, "its Pod cannot be made: POST")) << exit.how;
    EXPECT_TRUE(absl::StrContains(exit.how, absl::StrCat(status))) << exit.how;
  }
  EXPECT_EQ(server_.Count("POST"), 2);
}

TEST_F(PodAllocatorTest, ServerWithoutItsPodSaysWhatIsInTheWay) {
  Open();
  server_.Inject({.method = "POST", .times = -1, .status = 503});
  ASSERT_TRUE(allocator_->Start(StartOf(0, 1)).ok());
  EXPECT_TRUE(Await([&] { return absl::StrContains(allocator_->Newest()[0].waits, "cannot be made yet: POST"); }));
  EXPECT_EQ(allocator_->running(), 1);
}

struct FaultCase {
  const char* name;
  Fault fault;
};
void PrintTo(const FaultCase& tested, std::ostream* out) { *out << tested.name; }

Fault OfMaking(Fault fault) {
  fault.method = "POST";
  fault.target = "pods";
  return fault;
}
Fault OfWatch(Fault fault) {
  fault.target = "watch=1";
  return fault;
}

// A life of three servers with the fault in its way: two are started, one of them dies and is replaced, one ends.
class PodAllocatorFault : public PodAllocatorTest, public testing::WithParamInterface<FaultCase> {};

TEST_P(PodAllocatorFault, EachServerIsMadeOnceAndItsEndToldOnce) {
  Open();
  server_.Inject(GetParam().fault);
  server_.CutWatches();
  Run(0, 1);
  Run(1, 1);
  server_.Merge(PathOf(0, 1), Exited(3, "Error"));
  if (GetParam().fault.kind == Kind::kHang) {
    ASSERT_TRUE(Await([&] { return server_.faults_left() == 0; }));
    server_.Release();
  }
  ServerExit exit = AwaitExit();
  EXPECT_EQ(exit.region, 0);
  EXPECT_EQ(exit.how, "exit status 3");
  Run(0, 2);
  server_.Remove(PathOf(1, 1));
  exit = AwaitExit();
  EXPECT_EQ(exit.region, 1);
  EXPECT_EQ(exit.incarnation, 1u);
  EXPECT_EQ(allocator_->running(), 1);
  EXPECT_TRUE(Await([&] { return server_.faults_left() == 0; })) << "the fault was not met";
  EXPECT_TRUE(Await([&] {
    const std::optional<Json> old = server_.At(PathOf(0, 1));
    return !old || ReadPod(*old)->leaving;
  }));
  EXPECT_TRUE(allocator_->Poll().empty());
  EXPECT_FALSE(ReadPod(*server_.At(PathOf(0, 2)))->leaving);
}

INSTANTIATE_TEST_SUITE_P(
    kAllFaults, PodAllocatorFault,
    testing::Values(FaultCase{"MakingStatus429", OfMaking({.times = 3, .status = 429})},
                    FaultCase{"MakingStatus429WithRetryAfter", OfMaking({.status = 429, .retry_after = 1})},
                    FaultCase{"MakingStatus500", OfMaking({.times = 3, .status = 500})},
                    FaultCase{"MakingStatus503", OfMaking({.times = 3, .status = 503})},
                    FaultCase{"MakingConflict", OfMaking({.times = 2, .status = 409})},
                    FaultCase{"MakingReplyLost", OfMaking({.kind = Kind::kLostReply, .times = 2})},
                    FaultCase{"MakingReplyCut", OfMaking({.kind = Kind::kBrokenJson, .times = 2})},
                    FaultCase{"MakingReplyLate", OfMaking({.kind = Kind::kSlow, .delay = milliseconds(700)})},
                    FaultCase{"MakingTokenExpired", OfMaking({.times = 2, .status = 401})},
                    FaultCase{"WatchCutInALine", OfWatch({.kind = Kind::kHalfLine, .times = 3})},
                    FaultCase{"WatchGoneByHttpStatus", OfWatch({.times = 2, .status = 410})},
                    FaultCase{"WatchGoneByErrorEvent", OfWatch({.kind = Kind::kGoneEvent, .times = 2})},
                    FaultCase{"WatchStatus500", OfWatch({.times = 3, .status = 500})},
                    FaultCase{"WatchGarbage", OfWatch({.kind = Kind::kGarbageLine})},
                    FaultCase{"WatchHangs", OfWatch({.kind = Kind::kHang})},
                    FaultCase{"ListStatus429", {.target = "limit=", .times = 2, .status = 429}},
                    FaultCase{"RemovingStatus503", {.method = "DELETE", .times = 2, .status = 503}},
                    FaultCase{"RemovingReplyLost", {.kind = Kind::kLostReply, .method = "DELETE", .times = 1}},
                    FaultCase{"LogForbidden", {.target = "/log", .status = 403}},
                    FaultCase{"LogHangs", {.kind = Kind::kSlow, .target = "/log", .delay = milliseconds(3000)}}),
    [](const auto& tested) { return std::string(tested.param.name); });

TEST_F(PodAllocatorTest, EndsAreToldThoughTheServerWasAway) {
  Open();
  Run(0, 1);
  Run(1, 1);
  ASSERT_TRUE(Await([&] { return allocator_->Newest()[0].started && allocator_->Newest()[1].started; }));
  server_.Stop();
  ASSERT_TRUE(allocator_->Start(StartOf(2, 1)).ok());
  server_.Remove(PathOf(0, 1));
  server_.Merge(PathOf(1, 1), Exited(1, "Error"));
  ASSERT_TRUE(Await([&] { return !allocator_->Newest()[2].waits.empty(); }));
  server_.ForgetHistory();
  server_.Start();
  std::vector<std::string> how = {AwaitExit().how, AwaitExit().how};
  std::sort(how.begin(), how.end());
  EXPECT_EQ(how, (std::vector<std::string>{"deleted", "exit status 1"}));
  EXPECT_TRUE(AwaitPod(2, 1));
}

}  // namespace
}  // namespace aureole::kubernetes
