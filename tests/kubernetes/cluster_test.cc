// The client against the real API server of $KUBECONFIG, in a namespace and with a resource definition of its own, both
// removed at the end.
#include <gtest/gtest.h>

#include <unistd.h>

#include <absl/strings/str_cat.h>

#include "server/control/kubernetes/api_status.h"
#include "server/control/kubernetes/cluster_access.h"
#include "server/control/kubernetes/event_recorder.h"
#include "server/control/kubernetes/leader_elector.h"
#include "server/control/kubernetes/pod_allocator.h"
#include "server/control/kubernetes/reflector.h"
#include "server/control/kubernetes/status_store.h"
#include "tests/kubernetes/await.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;

const Resource kNamespaces{"", "v1", "namespaces", ""};
const Resource kDefinitions{"apiextensions.k8s.io", "v1", "customresourcedefinitions", ""};

class Cluster : public testing::Test {
 protected:
  static void SetUpTestSuite() {
    const auto access = FindAccess("");
    ASSERT_TRUE(access.ok()) << access.status();
    client_ = new ApiClient(*access);
    static int suites = 0;  // a namespace goes only slowly
    space_ = absl::StrCat("aureole-test-", getpid(), "-", ++suites);
    group_ = absl::StrCat("t", getpid(), "-", suites, ".aureole.example");
    worlds_ = {group_, "v1", "worlds", space_};
    config_maps_ = {"", "v1", "configmaps", space_};
    ASSERT_TRUE(client_->Create(kNamespaces, {{"metadata", {{"name", space_}}}}).ok());
    const Json schema = {
        {"type", "object"},
        {"properties",
         {{"spec", {{"type", "object"}, {"properties", {{"regions", {{"type", "integer"}, {"minimum", 1}}}}}}},
          {"status", {{"type", "object"}, {"x-kubernetes-preserve-unknown-fields", true}}}}}};
    const Json version = {{"name", "v1"},
                          {"served", true},
                          {"storage", true},
                          {"subresources", {{"status", Json::object()}}},
                          {"schema", {{"openAPIV3Schema", schema}}}};
    const absl::Status made =
        client_
            ->Create(kDefinitions, {{"apiVersion", "apiextensions.k8s.io/v1"},
                                    {"kind", "CustomResourceDefinition"},
                                    {"metadata", {{"name", "worlds." + group_}}},
                                    {"spec",
                                     {{"group", group_},
                                      {"scope", "Namespaced"},
                                      {"names", {{"plural", "worlds"}, {"singular", "world"}, {"kind", "World"}}},
                                      {"versions", Json::array({version})}}}})
            .status();
    ASSERT_TRUE(made.ok()) << made;
    ASSERT_TRUE(Await([] { return client_->List(worlds_).ok(); }));
  }
  static void TearDownTestSuite() {
    if (client_ == nullptr) return;
    EXPECT_TRUE(client_->Delete(kDefinitions, "worlds." + group_).ok());
    EXPECT_TRUE(client_->Delete(kNamespaces, space_).ok());
    delete client_;
  }
  static Json World(const std::string& name, int regions) {
    return {{"apiVersion", worlds_.ApiVersion()},
            {"kind", "World"},
            {"metadata", {{"name", name}, {"namespace", space_}}},
            {"spec", {{"regions", regions}}}};
  }

  static inline ApiClient* client_ = nullptr;
  static inline std::string space_, group_;
  static inline Resource worlds_, config_maps_;
};

TEST_F(Cluster, CustomObjectIsWatchedAndItsStatusIsASubresource) {
  Wakeup wakeup;
  Reflector reflector(client_, {.resource = worlds_}, &wakeup);
  const auto seen = [&](const std::string& name) -> Object {
    const Objects objects = reflector.objects();
    const auto found = objects.find(space_ + "/" + name);
    return found == objects.end() ? nullptr : found->second;
  };
  ASSERT_TRUE(Await([&] { return reflector.synced(); }));
  ASSERT_TRUE(client_->Create(worlds_, World("w", 4)).ok());
  ASSERT_TRUE(Await([&] { return seen("w") != nullptr; }));
  EXPECT_EQ(IntegerAt(*seen("w"), {"metadata", "generation"}), 1);

  const Patch status{.body = {{"status", {{"phase", "Ready"}}}, {"spec", {{"regions", 9}}}}};
  ASSERT_TRUE(client_->Patch(worlds_.Sub("status"), "w", status).ok());
  ASSERT_TRUE(Await([&] { return TextAt(*seen("w"), {"status", "phase"}) == "Ready"; }));
  EXPECT_EQ(IntegerAt(*seen("w"), {"spec", "regions"}), 4);
  EXPECT_EQ(IntegerAt(*seen("w"), {"metadata", "generation"}), 1);

  ASSERT_TRUE(client_->Patch(worlds_, "w", {.body = {{"spec", {{"regions", 6}}}, {"status", {{"phase", "x"}}}}}).ok());
  ASSERT_TRUE(Await([&] { return IntegerAt(*seen("w"), {"metadata", "generation"}) == 2; }));
  EXPECT_EQ(TextAt(*seen("w"), {"status", "phase"}), "Ready");

  const Patch test{Patch::Kind::kJson, Json::array({{{"op", "test"}, {"path", "/spec/regions"}, {"value", 6}},
                                                    {{"op", "replace"}, {"path", "/spec/regions"}, {"value", 7}}})};
  EXPECT_TRUE(client_->Patch(worlds_, "w", test).ok());
  EXPECT_TRUE(absl::IsInvalidArgument(client_->Patch(worlds_, "w", test).status()));

  const Patch apply{Patch::Kind::kApply, World("applied", 2), "aureole", true};
  ASSERT_TRUE(client_->Patch(worlds_, "applied", apply).ok());
  ASSERT_TRUE(Await([&] { return seen("applied") != nullptr; }));
  ASSERT_TRUE(client_->Delete(worlds_, "applied", {.uid = TextAt(*seen("applied"), {"metadata", "uid"})}).ok());
  ASSERT_TRUE(Await([&] { return seen("applied") == nullptr; }));
  EXPECT_EQ(reflector.stats().lists, 1);
  EXPECT_TRUE(reflector.health().ok()) << reflector.health();
}

TEST_F(Cluster, RefusalsHaveTheirCodes) {
  EXPECT_TRUE(absl::IsNotFound(client_->Get(worlds_, "none").status()));
  const absl::Status invalid = client_->Create(worlds_, World("bad", 0)).status();
  EXPECT_TRUE(absl::IsInvalidArgument(invalid)) << invalid;
  EXPECT_EQ(ReasonOf(invalid), "Invalid");
  Json made = client_->Create(worlds_, World("twice", 1)).value();
  EXPECT_TRUE(absl::IsAlreadyExists(client_->Create(worlds_, World("twice", 1)).status()));
  made["spec"]["regions"] = 2;
  ASSERT_TRUE(client_->Replace(worlds_, made).ok());
  EXPECT_TRUE(absl::IsAborted(client_->Replace(worlds_, made).status()));
  EXPECT_TRUE(absl::IsAborted(client_->Delete(worlds_, "twice", {.uid = "another"})));
  ClusterAccess stranger = FindAccess("").value();
  stranger.client_certificate.clear();
  stranger.client_key.clear();
  stranger.token = "wrong";
  EXPECT_TRUE(absl::IsUnauthenticated(ApiClient(stranger).Get(worlds_, "w").status()));
  stranger.token.clear();
  const absl::Status forbidden = ApiClient(stranger).Get(worlds_, "w").status();
  EXPECT_TRUE(absl::IsPermissionDenied(forbidden)) << forbidden;
  ClusterAccess fooled = FindAccess("").value();
  fooled.server = "https://127.0.0.2" + fooled.server.substr(fooled.server.rfind(':'));
  EXPECT_FALSE(ApiClient(fooled).Get(worlds_, "w", {.attempts = 1}).ok());
}

TEST_F(Cluster, ListsInPagesAndWatchesFromThere) {
  constexpr int kMaps = ApiClient::kPage + 20;
  for (int i = 0; i < kMaps; ++i) {
    ASSERT_TRUE(
        client_
            ->Create(config_maps_, {{"metadata", {{"name", absl::StrCat("m", i)}, {"labels", {{"app", "aureole"}}}}}})
            .ok());
  }
  Wakeup wakeup;
  Reflector reflector(client_, {.resource = config_maps_, .selection = {.labels = "app=aureole"}}, &wakeup);
  ASSERT_TRUE(Await([&] { return reflector.synced(); }));
  EXPECT_EQ(reflector.objects().size(), kMaps);
  EXPECT_EQ(reflector.Take().size(), kMaps);
  ASSERT_TRUE(client_->Delete(config_maps_, "m7").ok());
  ASSERT_TRUE(Await([&] { return reflector.objects().size() == kMaps - 1; }));
  const auto changes = reflector.Take();
  ASSERT_EQ(changes.size(), 1u);
  EXPECT_EQ(changes[0].kind, Change::Kind::kDeleted);
  const auto began = std::chrono::steady_clock::now();
  reflector.Stop();
  EXPECT_LT(std::chrono::steady_clock::now() - began, milliseconds(500));
}

TEST_F(Cluster, WatchesEndInTimeAndVersionsThatAreTooOldAreGone) {
  const auto now = client_->List(worlds_);
  ASSERT_TRUE(now.ok());
  const auto watch = [&](const std::string& version) {
    return client_->Watch(worlds_, {}, version, {.timeout = seconds(1)},
                          [](const WatchEvent&) { return absl::OkStatus(); });
  };
  EXPECT_TRUE(watch(now->resource_version).ok());
  const absl::Status gone = watch("1");
  EXPECT_TRUE(absl::IsOutOfRange(gone)) << gone;
}

TEST_F(Cluster, LeaseIsHeldRenewedReleasedAndTaken) {
  Wakeup wakeup;
  const ElectionTiming timing{milliseconds(4000), milliseconds(3000), milliseconds(300)};
  const Resource leases{"coordination.k8s.io", "v1", "leases", space_};
  LeaderElector a(client_, {space_, "leader", "a", timing}, &wakeup);
  ASSERT_TRUE(Await([&] { return a.Epoch().has_value(); })) << a.health();
  EXPECT_EQ(a.Epoch(), 1);
  const std::string renewed = LeaseOf(client_->Get(leases, "leader").value()).renewed;
  LeaderElector b(client_, {space_, "leader", "b", timing}, &wakeup);
  ASSERT_TRUE(Await([&] { return LeaseOf(client_->Get(leases, "leader").value()).renewed != renewed; }));
  ASSERT_TRUE(Await([&] { return b.holder() == a.identity(); })) << b.health();
  EXPECT_EQ(b.Epoch(), std::nullopt);
  a.Stop();
  EXPECT_EQ(a.Epoch(), std::nullopt);
  ASSERT_TRUE(Await([&] { return b.Epoch().has_value(); })) << b.health();
  EXPECT_EQ(b.Epoch(), 2);
}

TEST_F(Cluster, RepeatedEventsAreCounted) {
  const absl::StatusOr<Json> world = client_->Create(worlds_, World("eventful", 1));
  ASSERT_TRUE(world.ok()) << world.status();
  EventRecorder recorder(client_, {"aureole-control", "test", milliseconds(50)});
  for (int i = 0; i < 50; ++i) {
    recorder.Record({ReferenceTo(*world, worlds_.ApiVersion(), "World"), true, "RegionLost", "region 1 is lost"});
  }
  ASSERT_TRUE(recorder.Flush(seconds(20)));
  EXPECT_EQ(recorder.stats().failed, 0);
  const auto events =
      client_->List({"", "v1", "events", space_}, {.fields = "involvedObject.name=eventful,reason=RegionLost"});
  ASSERT_TRUE(events.ok()) << events.status();
  ASSERT_EQ(events->items.size(), 1u);
  EXPECT_EQ(IntegerAt(events->items[0], {"count"}), 50);
}

// World objects, of a definition that takes all: that of k8s/ when it is there already.
class WorldCluster : public Cluster {
 protected:
  static void SetUpTestSuite() {
    Cluster::SetUpTestSuite();
    const Json any = {{"type", "object"}, {"x-kubernetes-preserve-unknown-fields", true}};
    const Json version = {{"name", kWorldVersion},
                          {"served", true},
                          {"storage", true},
                          {"subresources", {{"status", Json::object()}}},
                          {"schema", {{"openAPIV3Schema", any}}}};
    const absl::Status made = client_
                                  ->Create(kDefinitions, {{"metadata", {{"name", "worlds.aureole.dev"}}},
                                                          {"spec",
                                                           {{"group", kWorldGroup},
                                                            {"scope", "Namespaced"},
                                                            {"names", {{"plural", "worlds"}, {"kind", kWorldKind}}},
                                                            {"versions", Json::array({version})}}}})
                                  .status();
    made_ = made.ok();
    ASSERT_TRUE(made.ok() || absl::IsAlreadyExists(made)) << made;
    ASSERT_TRUE(Await([] { return client_->List(WorldsOf(space_)).ok(); }));
    // No Pod is taken before.
    ASSERT_TRUE(Await([] { return client_->Get({"", "v1", "serviceaccounts", space_}, "default").ok(); }));
    const Json spec = {{"world", {{"name", "w"}}}, {"storage", {{"emptyDir", Json::object()}}}};
    const absl::StatusOr<Json> world = client_->Create(WorldsOf(space_), {{"apiVersion", WorldsOf(space_).ApiVersion()},
                                                                          {"kind", kWorldKind},
                                                                          {"metadata", {{"name", "w"}}},
                                                                          {"spec", spec}});
    ASSERT_TRUE(world.ok()) << world.status();
    uid_ = TextAt(*world, {"metadata", "uid"});
  }
  static void TearDownTestSuite() {
    if (made_) {
      EXPECT_TRUE(client_->Delete(kDefinitions, "worlds.aureole.dev").ok());
    }
    Cluster::TearDownTestSuite();
  }

  static inline bool made_ = false;
  static inline std::string uid_;
};

// Without nodes, or with: the image is nowhere, so no Pod ever runs.
TEST_F(WorldCluster, PodsAreTakenAsTheyAreMeantAndGoAgain) {
  PodAllocator::Options options;
  options.pods.world = "w";
  options.pods.space = space_;
  options.pods.uid = uid_;
  options.pods.image = "localhost/aureole:none";
  options.pods.pull_policy = "Never";
  options.pods.resources = {{"requests", {{"cpu", "10m"}}}};
  options.pods.node_selector = {{"aureole.dev/none", "none"}};
  options.pods.tolerations = Json::array({{{"key", "a"}, {"operator", "Exists"}}});
  options.pods.storage = {.kind = Storage::Kind::kVolumeClaim, .size = "1Mi"};
  options.pods.neighbours = {{1}, {0}};
  const Resource pods{"", "v1", "pods", space_};
  {
    PodAllocator allocator(client_, options);
    const ServerStart start{0, 1, "token", "10.0.0.1:7100"};
    const Json wanted = PodManifest(options.pods, start);
    ASSERT_TRUE(allocator.Start(start).ok());
    ASSERT_TRUE(Await([&] { return client_->Get(pods, "w-r0-i1").ok(); })) << allocator.Newest()[0].waits;
    const Json there = client_->Get(pods, "w-r0-i1").value();
    // The server drops fields that it does not know, and adds what was not given.
    for (const char* field : {"affinity", "securityContext", "restartPolicy", "nodeSelector"}) {
      EXPECT_EQ(there["spec"][field], wanted["spec"][field]) << field;
    }
    const Json &is = there["spec"]["containers"][0], &as = wanted["spec"]["containers"][0];
    for (const char* field : {"args", "command", "resources", "securityContext", "imagePullPolicy", "volumeMounts"}) {
      EXPECT_EQ(is[field], as[field]) << field;
    }
    for (const char* probe : {"readinessProbe", "livenessProbe"}) {
      Json whole = is[probe];
      whole.merge_patch(as[probe]);
      EXPECT_EQ(is[probe], whole) << probe;
    }
    EXPECT_TRUE(client_->Get({"", "v1", "persistentvolumeclaims", space_}, "w-region-0").ok());
    EXPECT_TRUE(absl::IsAlreadyExists(client_->Create(pods, wanted).status()));
    EXPECT_TRUE(allocator.Poll().empty());
    allocator.Release();
  }
  PodAllocator next(client_, options);
  const auto adopted = next.Adopt();
  ASSERT_TRUE(adopted.ok()) << adopted.status();
  ASSERT_EQ(adopted->size(), 1u);
  EXPECT_EQ((*adopted)[0].token, "token");
  ASSERT_TRUE(client_->Delete(pods, "w-r0-i1").ok());
  std::vector<ServerExit> exits;
  ASSERT_TRUE(Await([&] {
    exits = next.Poll();
    return !exits.empty();
  }));
  EXPECT_EQ(exits[0].how, "deleted");
  ASSERT_TRUE(next.Start({1, 1, "other", "10.0.0.1:7100"}).ok());
  ASSERT_TRUE(Await([&] { return client_->Get(pods, "w-r1-i1").ok(); }));
  next.Kill();
  EXPECT_TRUE(client_->List(pods)->items.empty());
}

TEST_F(WorldCluster, StatusAndRecordSurviveOtherWriters) {
  StatusStore::Options options;
  options.space = space_;
  options.name = "w";
  options.uid = uid_;
  options.interval = milliseconds(10);
  StatusStore store(client_, options);
  ASSERT_TRUE(store.Load().ok()) << store.Load().status();
  v1::WorldRecord record;
  record.set_world_hash(0xfedcba9876543210);
  record.add_regions()->set_incarnation(3);
  ASSERT_TRUE(store.Save(record).ok());
  ASSERT_TRUE(client_->Patch(WorldsOf(space_), "w", {.body = {{"metadata", {{"labels", {{"a", "b"}}}}}}}).ok());
  WorldStatus status;
  status.fields = {{"phase", "Running"}, {"tick", 7}, {"realTimeFactor", 0.99}};
  status.conditions = {{"Ready", true, "Running", ""}};
  status.generation = 1;
  store.Publish(status);
  ASSERT_TRUE(store.Flush(seconds(20)));
  record.mutable_regions(0)->set_incarnation(4);
  ASSERT_TRUE(store.Save(record).ok());
  const Json there = client_->Get(WorldsOf(space_), "w").value()["status"];
  EXPECT_EQ(there["tick"], 7);
  EXPECT_EQ(there["conditions"][0]["type"], "Ready");
  EXPECT_EQ(there["observedGeneration"], 1);
  StatusStore next(client_, options);
  const auto found = next.Load();
  ASSERT_TRUE(found.ok()) << found.status();
  EXPECT_EQ((*found)->SerializeAsString(), record.SerializeAsString());
}

}  // namespace
}  // namespace aureole::kubernetes
