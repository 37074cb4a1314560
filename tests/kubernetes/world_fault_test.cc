// Every request that a control plane makes meets every kind of failure, and the world ends bit for bit as one that
// nothing happened to: kAllFaults is the table.
#include <gtest/gtest.h>

#include <ostream>
#include <string>

#include "tests/kubernetes/world_life.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;

struct FaultCase {
  const char* name;
  Fault fault;
};
void PrintTo(const FaultCase& tested, std::ostream* out) { *out << tested.name; }

// Every request that a control plane makes meets every kind of failure, from before the first to after the last.
class WorldLifeFault : public WorldLife, public testing::WithParamInterface<FaultCase> {};

TEST_P(WorldLifeFault, EndsAsUndisturbed) {
  cluster_.api().Put("/api/v1/namespaces/test/configmaps/files", {{"data", {{"pile.json", FileText()}}}});
  Json spec = Spec();
  spec.erase("world");
  spec["worldFrom"] = {{"configMap", "files"}, {"key", "pile.json"}};
  spec["realTime"] = false;
  spec["storage"] = {{"volumeClaim", {{"size", "1Gi"}}}};
  cluster_.api().Inject(GetParam().fault);
  cluster_.StartControl(0);
  Create(spec);
  if (GetParam().fault.kind == Fault::Kind::kHang) {
    EXPECT_TRUE(Await([&] { return cluster_.api().faults_left() == 0; }));
    cluster_.api().Release();
  }
  ExpectEndAsUndisturbed();
  EXPECT_EQ(cluster_.api().faults_left(), 0u) << "the fault was not met";
  EXPECT_TRUE(Await([&] { return HasEvent("Finished"); }));
}

using Kind = Fault::Kind;
INSTANTIATE_TEST_SUITE_P(
    kAllFaults, WorldLifeFault,
    testing::Values(
        FaultCase{"LeaseStatus503", {.target = "/leases/", .times = 2, .status = 503}},
        FaultCase{"LeaseReplyLost", {.kind = Kind::kLostReply, .method = "POST", .target = "/leases"}},
        FaultCase{"OwnPodStatus500", {.target = "/pods/control-0", .times = 5, .status = 500}},
        FaultCase{"ServiceForbidden", {.target = "/services/", .times = 2, .status = 403}},
        FaultCase{"LabelStatus503", {.method = "PATCH", .target = "/pods/control-0", .times = 5, .status = 503}},
        FaultCase{"WorldsListStatus429", {.target = "/worlds?", .status = 429, .retry_after = 1}},
        FaultCase{"WorldsListReplyCut", {.kind = Kind::kBrokenJson, .target = "/worlds?limit", .times = 2}},
        FaultCase{"WorldsWatchCutInALine", {.kind = Kind::kHalfLine, .target = "/worlds?watch", .times = 3}},
        FaultCase{"WorldsWatchGoneByHttpStatus", {.target = "/worlds?watch", .times = 2, .status = 410}},
        FaultCase{"WorldsWatchGoneByErrorEvent", {.kind = Kind::kGoneEvent, .target = "/worlds?watch", .times = 2}},
        FaultCase{"WorldsWatchHangs", {.kind = Kind::kHang, .target = "/worlds?watch"}},
        FaultCase{"ConfigMapStatus503", {.target = "/configmaps/", .times = 6, .status = 503}},
        FaultCase{"RecordReadStatus500", {.target = "/worlds/w", .times = 3, .status = 500}},
        FaultCase{"StatusConflict", {.method = "PATCH", .target = "/worlds/w/status", .times = 4, .status = 409}},
        FaultCase{"StatusStatus503", {.method = "PATCH", .target = "/worlds/w/status", .times = 5, .status = 503}},
        FaultCase{"StatusReplyLost",
                  {.kind = Kind::kLostReply, .method = "PATCH", .target = "/worlds/w/status", .times = 3}},
        FaultCase{"StatusSlow",
                  {.kind = Kind::kSlow, .method = "PATCH", .target = "/status", .delay = milliseconds(1500)}},
        FaultCase{"ReplicasStatus503", {.method = "PATCH", .target = "/worlds/w/scale", .status = 503}},
        FaultCase{"ReplicasReplyLost", {.kind = Kind::kLostReply, .method = "PATCH", .target = "/worlds/w/scale"}},
        FaultCase{"ClaimStatus500", {.method = "POST", .target = "/persistentvolumeclaims", .times = 3, .status = 500}},
        FaultCase{"ClaimReplyLost", {.kind = Kind::kLostReply, .method = "POST", .target = "/persistentvolumeclaims"}},
        FaultCase{"AdoptionStatus503",
                  {.target = "/pods?labelSelector=aureole.dev%2Fworld", .times = 3, .status = 503}},
        FaultCase{"PodStatus429", {.method = "POST", .target = "/pods", .times = 3, .status = 429}},
        FaultCase{"PodReplyLost", {.kind = Kind::kLostReply, .method = "POST", .target = "/pods", .times = 2}},
        FaultCase{"PodSlow", {.kind = Kind::kSlow, .method = "POST", .target = "/pods", .delay = milliseconds(1500)}},
        FaultCase{"PodsWatchGone", {.kind = Kind::kGoneEvent, .target = "/pods?watch", .times = 2}},
        FaultCase{"RemovalStatus503", {.method = "DELETE", .target = "/pods/", .times = 3, .status = 503}},
        FaultCase{"EventsStatus500", {.method = "POST", .target = "/events", .times = 3, .status = 500}}),
    [](const auto& tested) { return std::string(tested.param.name); });

}  // namespace
}  // namespace aureole::kubernetes
