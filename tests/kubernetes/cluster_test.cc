// The client against the real API server of $KUBECONFIG, in a namespace and with a resource definition of its own, both
// removed at the end.
#include <gtest/gtest.h>

#include <unistd.h>

#include <absl/strings/str_cat.h>

#include "server/control/kubernetes/api_status.h"
#include "server/control/kubernetes/cluster_access.h"
#include "server/control/kubernetes/event_recorder.h"
#include "server/control/kubernetes/leader_elector.h"
#include "server/control/kubernetes/reflector.h"
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
    space_ = absl::StrCat("aureole-test-", getpid());
    group_ = absl::StrCat("t", getpid(), ".aureole.example");
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

}  // namespace
}  // namespace aureole::kubernetes
