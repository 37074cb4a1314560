// What a control plane takes from its own Pod and Service, and how the leader is marked.
#include "server/control/kubernetes/own_pod.h"

#include <gtest/gtest.h>

#include "tests/kubernetes/fake_api_server.h"

namespace aureole::kubernetes {
namespace {

constexpr char kPods[] = "/api/v1/namespaces/test/pods/";

Json Mount(const std::string& name, const std::string& path) { return {{"name", name}, {"mountPath", path}}; }
Json Volume(const std::string& name) { return {{"name", name}, {"secret", {{"secretName", name}}}}; }

TEST(OwnPod, ServersGetItsImageAndTheVolumesThatTheFlagsName) {
  const Json container = {{"image", "a:1"},
                          {"imagePullPolicy", "Never"},
                          {"volumeMounts", {Mount("t", "/tls"), Mount("k", "/tokens"), Mount("tmp", "/tmp")}}};
  const Json pod = {
      {"spec", {{"containers", Json::array({container})}, {"volumes", {Volume("t"), Volume("k"), Volume("tmp")}}}}};
  SecurityOptions security;
  security.tls = "/tls";
  security.tokens = "/tokens/tokens.json";
  const PodDefaults both = DefaultsOf(pod, security);
  EXPECT_EQ(both.image, "a:1");
  EXPECT_EQ(both.pull_policy, "Never");
  EXPECT_EQ(both.flags, (std::vector<std::string>{"--tls", "/tls", "--tokens", "/tokens/tokens.json"}));
  EXPECT_EQ(both.mounts, Json::array({Mount("t", "/tls"), Mount("k", "/tokens")}));
  EXPECT_EQ(both.volumes, Json::array({Volume("t"), Volume("k")}));

  security = {};
  security.insecure = true;
  const PodDefaults none = DefaultsOf(pod, security);
  EXPECT_EQ(none.flags, std::vector<std::string>{"--insecure"});
  EXPECT_TRUE(none.mounts.empty() && none.volumes.empty());
  EXPECT_EQ(DefaultsOf(Json::object(), security).image, "");
}

TEST(OwnPod, ServiceIsReachedByItsAddress) {
  FakeApiServer server;
  ApiClient client(server.Access());
  constexpr char kService[] = "/api/v1/namespaces/test/services/s";
  EXPECT_TRUE(absl::IsNotFound(AddressOf(&client, "s").status()));
  const auto put = [&](const std::string& ip, const Json& ports) {
    server.Put(kService, {{"spec", {{"clusterIP", ip}, {"ports", ports}}}});
  };
  const Json ports = Json::array({{{"name", "grpc"}, {"port", 7100}}});
  put("10.0.0.1", ports);
  EXPECT_EQ(AddressOf(&client, "s").value(), "10.0.0.1:7100");
  put("fd00::1", ports);
  EXPECT_EQ(AddressOf(&client, "s").value(), "[fd00::1]:7100");
  put("None", ports);
  EXPECT_TRUE(absl::IsFailedPrecondition(AddressOf(&client, "s").status()));
  put("10.0.0.1", Json::array());
  EXPECT_TRUE(absl::IsFailedPrecondition(AddressOf(&client, "s").status()));
}

TEST(OwnPod, OneLeaderHasTheLabel) {
  FakeApiServer server;
  ApiClient client(server.Access());
  const auto put = [&](const std::string& pod, const std::string& name, const std::string& role) {
    Json labels = {{"app.kubernetes.io/name", name}};
    if (!role.empty()) labels[kRoleLabel] = role;
    server.Put(kPods + pod, {{"metadata", {{"labels", labels}}}});
  };
  const auto role = [&](const std::string& pod) {
    return TextAt(*server.At(kPods + pod), {"metadata", "labels", kRoleLabel});
  };
  put("a", kControlName, kLeader);
  put("b", kControlName, "");
  put("c", kControlName, kLeader);
  put("d", "another-program", kLeader);
  ASSERT_TRUE(LabelLeader(&client, "b").ok());
  EXPECT_EQ(role("a") + role("b") + role("c"), kLeader);
  EXPECT_EQ(role("b"), kLeader);
  EXPECT_EQ(role("d"), kLeader);
  const int writes = server.Count("PATCH");
  ASSERT_TRUE(LabelLeader(&client, "b").ok());
  EXPECT_EQ(server.Count("PATCH"), writes);
  server.Inject({.kind = Fault::Kind::kStatus, .times = 4, .status = 503});
  EXPECT_FALSE(LabelLeader(&client, "a").ok());
  EXPECT_EQ(role("b"), kLeader);
}

}  // namespace
}  // namespace aureole::kubernetes
