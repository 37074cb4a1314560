// What a region's Pod asks for, and what its status is taken for.
#include "server/control/kubernetes/pod.h"

#include <gtest/gtest.h>

#include <algorithm>

namespace aureole::kubernetes {
namespace {

PodTemplate Template() {
  PodTemplate pods;
  pods.world = "demo";
  pods.space = "games";
  pods.uid = "world-uid";
  pods.image = "localhost/aureole:test";
  pods.flags = {"--insecure"};
  pods.neighbours = {{1, 2}, {0}, {0}, {}};
  return pods;
}

const ServerStart kStart{2, 7, "secret", "10.0.0.1:7100", "10.1.1.1:7000"};

Json Container(const Json& pod) { return pod["spec"]["containers"][0]; }

TEST(PodManifest, IsWhatItWasMadeOf) {
  Json pod = PodManifest(Template(), kStart);
  EXPECT_EQ(TextAt(pod, {"metadata", "name"}), "demo-r2-i7");
  EXPECT_EQ(TextAt(pod, {"metadata", "labels", "app.kubernetes.io/name"}), "aureole-region");
  const Json owner = {{"apiVersion", "aureole.dev/v1alpha1"},
                      {"kind", "World"},
                      {"name", "demo"},
                      {"uid", "world-uid"},
                      {"controller", true},
                      {"blockOwnerDeletion", true}};
  EXPECT_EQ(pod["metadata"]["ownerReferences"], Json::array({owner}));
  pod["metadata"]["uid"] = "pod-uid";
  pod["spec"]["nodeName"] = "n1";
  pod["status"]["podIP"] = "10.1.2.3";
  const std::optional<PodView> view = ReadPod(pod);
  ASSERT_TRUE(view);
  EXPECT_EQ(view->start.region, 2);
  EXPECT_EQ(view->start.incarnation, 7u);
  EXPECT_EQ(view->start.token, "secret");
  EXPECT_EQ(view->start.control, "10.0.0.1:7100");
  EXPECT_EQ(view->start.listen, "10.1.2.3:7000");
  EXPECT_EQ(view->name, "demo-r2-i7");
  EXPECT_EQ(view->uid, "pod-uid");
  EXPECT_EQ(view->owner, "world-uid");
  EXPECT_EQ(view->node, "n1");
  EXPECT_FALSE(view->started || view->leaving);
}

TEST(PodManifest, ServerIsToldAllItNeeds) {
  const Json expected = {"--control", "10.0.0.1:7100", "--world",        "demo",      "--token",
                         "secret",    "--listen",      "$(POD_IP):7000", "--metrics", "$(POD_IP):9100",
                         "--data",    "/data",         "--insecure"};
  EXPECT_EQ(Container(PodManifest(Template(), kStart))["args"], expected);
}

TEST(PodManifest, EndsForGoodAndHasNoRights) {
  const Json spec = PodManifest(Template(), kStart)["spec"];
  EXPECT_EQ(spec["restartPolicy"], "Never");
  EXPECT_EQ(spec["automountServiceAccountToken"], false);
  EXPECT_EQ(spec["terminationGracePeriodSeconds"], 30);
  EXPECT_EQ(spec["securityContext"]["runAsUser"], 65532);
  EXPECT_EQ(spec["containers"][0]["securityContext"]["readOnlyRootFilesystem"], true);
  EXPECT_FALSE(spec.contains("serviceAccountName") || spec.contains("nodeSelector") || spec.contains("tolerations"));
}

TEST(PodManifest, TakesOverWhatTheWorldSays) {
  PodTemplate pods = Template();
  pods.pull_policy = "Never";
  pods.resources = {{"requests", {{"cpu", "1"}}}};
  pods.node_selector = {{"disk", "fast"}};
  pods.tolerations = Json::array({{{"key", "a"}, {"operator", "Exists"}}});
  pods.service_account = "regions";
  pods.volumes = Json::array({{{"name", "tls"}, {"secret", {{"secretName", "s"}}}}});
  pods.mounts = Json::array({{{"name", "tls"}, {"mountPath", "/tls"}}});
  const Json spec = PodManifest(pods, kStart)["spec"];
  EXPECT_EQ(spec["containers"][0]["image"], "localhost/aureole:test");
  EXPECT_EQ(spec["containers"][0]["imagePullPolicy"], "Never");
  EXPECT_EQ(spec["containers"][0]["resources"], pods.resources);
  EXPECT_EQ(spec["nodeSelector"], pods.node_selector);
  EXPECT_EQ(spec["tolerations"], pods.tolerations);
  EXPECT_EQ(spec["serviceAccountName"], "regions");
  EXPECT_EQ(spec["volumes"].back(), pods.volumes[0]);
  EXPECT_EQ(spec["containers"][0]["volumeMounts"].back(), pods.mounts[0]);
}

TEST(PodManifest, RegionsAreSpreadOverHostsFirstAndNeighboursAreClose) {
  const Json spec = PodManifest(Template(), {0, 1, "", ""})["spec"];
  const auto weighed = [&spec](const char* kind) {
    return spec["affinity"][kind]["preferredDuringSchedulingIgnoredDuringExecution"][0];
  };
  const Json near = weighed("podAffinity"), apart = weighed("podAntiAffinity");
  const Json world = {{"aureole.dev/world", "demo"}};
  EXPECT_EQ(near["podAffinityTerm"]["topologyKey"], "topology.kubernetes.io/zone");
  EXPECT_EQ(near["podAffinityTerm"]["labelSelector"]["matchLabels"], world);
  EXPECT_EQ(near["podAffinityTerm"]["labelSelector"]["matchExpressions"][0]["values"], (Json{"1", "2"}));
  EXPECT_EQ(apart["podAffinityTerm"]["topologyKey"], "kubernetes.io/hostname");
  EXPECT_EQ(apart["podAffinityTerm"]["labelSelector"], (Json{{"matchLabels", world}}));
  // Also where each host is a zone, and all 8 neighbours of a region of a grid are on it.
  EXPECT_GT(apart["weight"].get<int>(), 8 * near["weight"].get<int>());
  EXPECT_GT(near["weight"].get<int>(), 0);
  const Json spread = {{"maxSkew", 1},
                       {"topologyKey", "kubernetes.io/hostname"},
                       {"whenUnsatisfiable", "ScheduleAnyway"},
                       {"labelSelector", {{"matchLabels", world}}}};
  EXPECT_EQ(spec["topologySpreadConstraints"], Json::array({spread}));
  EXPECT_FALSE(PodManifest(Template(), {3, 1, "", ""})["spec"]["affinity"].contains("podAffinity"));
}

TEST(PodManifest, NodesThatAreAvoidedAreExcludedByName) {
  Json pod = PodManifest(Template(), kStart, {"n1", "n2"});
  const Json required = pod["spec"]["affinity"]["nodeAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"];
  ASSERT_EQ(required["nodeSelectorTerms"].size(), 1u) << "of several, one would do";
  const Json fields = required["nodeSelectorTerms"][0]["matchFields"];
  ASSERT_EQ(fields.size(), 2u);
  EXPECT_EQ(fields[1], (Json{{"key", "metadata.name"}, {"operator", "NotIn"}, {"values", Json::array({"n2"})}}));
  EXPECT_TRUE(pod["spec"]["affinity"].contains("podAntiAffinity"));
  EXPECT_TRUE(ReadPod(pod)->avoids);
  pod = PodManifest(Template(), kStart);
  EXPECT_FALSE(pod["spec"]["affinity"].contains("nodeAffinity"));
  EXPECT_FALSE(ReadPod(pod)->avoids);
}

TEST(PodManifest, VolumeFollowsTheRegion) {
  PodTemplate pods = Template();
  const auto data = [&] { return PodManifest(pods, kStart)["spec"]["volumes"][0]; };
  const auto directory = [&] {
    const Json args = Container(PodManifest(pods, kStart))["args"];
    return std::next(std::find(args.begin(), args.end(), "--data"))->get<std::string>();
  };
  EXPECT_EQ(data(), (Json{{"name", "data"}, {"emptyDir", Json::object()}}));
  EXPECT_EQ(directory(), "/data");
  EXPECT_FALSE(ClaimManifest(pods, 2));

  pods.storage = {.kind = Storage::Kind::kHostPath, .host_path = "/var/lib/aureole"};
  EXPECT_EQ(data()["hostPath"]["path"], "/var/lib/aureole");
  EXPECT_EQ(directory(), "/data/demo/region-2");
  EXPECT_FALSE(ClaimManifest(pods, 2));

  pods.storage = {.kind = Storage::Kind::kVolumeClaim, .storage_class = "fast", .size = "2Gi"};
  EXPECT_EQ(data()["persistentVolumeClaim"]["claimName"], "demo-region-2");
  EXPECT_EQ(directory(), "/data");
  const std::optional<Json> claim = ClaimManifest(pods, 2);
  ASSERT_TRUE(claim);
  EXPECT_EQ(TextAt(*claim, {"metadata", "name"}), "demo-region-2");
  EXPECT_EQ(TextAt(*claim, {"spec", "storageClassName"}), "fast");
  EXPECT_EQ(TextAt(*claim, {"spec", "resources", "requests", "storage"}), "2Gi");
  EXPECT_EQ((*claim)["metadata"]["ownerReferences"][0]["uid"], "world-uid");
}

TEST(ReadPod, OtherPodsAreNone) {
  EXPECT_FALSE(ReadPod(Json::object()));
  EXPECT_FALSE(ReadPod({{"metadata", {{"labels", {{kRegionLabel, "x"}, {kIncarnationLabel, "1"}}}}}}));
  EXPECT_FALSE(ReadPod({{"metadata", {{"labels", {{kRegionLabel, "-1"}, {kIncarnationLabel, "1"}}}}}}));
  EXPECT_FALSE(ReadPod({{"metadata", {{"labels", {{kRegionLabel, "1"}}}}}}));
}

Json Terminated(int code, const std::string& reason) {
  return {
      {"phase", code == 0 ? "Succeeded" : "Failed"},
      {"containerStatuses", Json::array({{{"state", {{"terminated", {{"exitCode", code}, {"reason", reason}}}}}}})}};
}
Json Waiting(const std::string& reason, const std::string& message) {
  return {{"phase", "Pending"},
          {"containerStatuses", Json::array({{{"state", {{"waiting", {{"reason", reason}, {"message", message}}}}}}})}};
}
const Json kRunning = {{"phase", "Running"},
                       {"containerStatuses", Json::array({{{"state", {{"running", Json::object()}}}}})}};
Json Unschedulable(const std::string& message) {
  return {{"phase", "Pending"},
          {"conditions", Json::array({{{"type", "PodScheduled"}, {"status", "False"}, {"message", message}}})}};
}

TEST(EndOf, IsToldInWords) {
  const struct {
    Json status;
    const char* how;  // null: it has not ended
    bool clean;
  } cases[] = {
      {nullptr, nullptr, false},
      {{{"phase", "Pending"}}, nullptr, false},
      {kRunning, nullptr, false},
      {Waiting("ErrImageNeverPull", "absent"), nullptr, false},
      {Unschedulable("0/2 nodes are available"), nullptr, false},
      {Terminated(0, "Completed"), "exit status 0", true},
      {Terminated(1, "Error"), "exit status 1", false},
      {Terminated(137, "OOMKilled"), "exit status 137 (OOMKilled)", false},
      {Terminated(128, "StartError"), "exit status 128 (StartError)", false},
      {{{"phase", "Failed"}, {"reason", "Evicted"}, {"message", "The node was low on memory."}},
       "Evicted: The node was low on memory.",
       false},
      {{{"phase", "Failed"}, {"reason", "OutOfcpu"}}, "OutOfcpu", false},
      {{{"phase", "Failed"}}, "its Pod has failed", false},
      {{{"phase", "Succeeded"}}, "exit status 0", true},
      {{{"phase", "Running"}, {"reason", "NodeLost"}, {"message", "n1 is unresponsive"}},
       "node lost: n1 is unresponsive",
       false},
      {{{"phase", "Unknown"}}, "node lost", false},
  };
  for (const auto& tested : cases) {
    const std::optional<PodEnd> end = EndOf({{"status", tested.status}});
    ASSERT_EQ(end.has_value(), tested.how != nullptr) << tested.status;
    if (!end) continue;
    EXPECT_EQ(end->how, tested.how);
    EXPECT_EQ(end->clean, tested.clean) << tested.how;
  }
}

TEST(ReadPod, SaysWhyItHasNotStarted) {
  const auto read = [](const Json& status) {
    Json pod = PodManifest(Template(), kStart);
    pod["status"] = status;
    return *ReadPod(pod);
  };
  EXPECT_EQ(read(Unschedulable("0/2 nodes are available: 2 Insufficient cpu.")).waits,
            "cannot be scheduled: 0/2 nodes are available: 2 Insufficient cpu.");
  EXPECT_EQ(read(Waiting("ErrImageNeverPull", "it is absent")).waits, "cannot start: ErrImageNeverPull: it is absent");
  EXPECT_EQ(read(Waiting("ContainerCreating", "")).waits, "cannot start: ContainerCreating");
  EXPECT_EQ(read({{"phase", "Pending"}}).waits, "");
  EXPECT_TRUE(read(kRunning).started);
  EXPECT_TRUE(read(Terminated(1, "Error")).started);
  EXPECT_FALSE(read(Unschedulable("x")).started);
  EXPECT_TRUE(read(Unschedulable("x")).unschedulable);
  EXPECT_FALSE(read({{"phase", "Pending"}}).unschedulable);
}

TEST(ReadPod, NodeHasTakenItOnceItSaysSomething) {
  const auto taken = [](const Json& status) {
    Json pod = PodManifest(Template(), kStart);
    pod["spec"]["nodeName"] = "n1";
    pod["status"] = status;
    return ReadPod(pod)->taken;
  };
  const Json scheduled = {{"phase", "Pending"},
                          {"qosClass", "Burstable"},
                          {"conditions", Json::array({{{"type", "PodScheduled"}, {"status", "True"}}})}};
  EXPECT_FALSE(taken(scheduled)) << "that is the scheduler's word";
  Json pulls = scheduled;
  pulls["startTime"] = "2026-01-01T00:00:00Z";
  EXPECT_TRUE(taken(pulls));
  EXPECT_TRUE(taken(Waiting("ContainerCreating", "")));
  EXPECT_TRUE(taken(kRunning));
}

}  // namespace
}  // namespace aureole::kubernetes
