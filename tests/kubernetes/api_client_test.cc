// Requests: paths, patches, concurrency, errors with their codes, and repetition where it does no harm.
#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <thread>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>

#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/api_status.h"
#include "server/control/kubernetes/backoff.h"
#include "tests/kubernetes/await.h"
#include "tests/kubernetes/fake_api_server.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using Clock = std::chrono::steady_clock;
using Kind = Fault::Kind;
using absl::StatusCode;

const Resource kPods{"", "v1", "pods", "test"};
const Resource kWorlds{"aureole.example", "v1", "worlds", "test"};
constexpr char kPodPath[] = "/api/v1/namespaces/test/pods/";

Json Named(const std::string& name) { return {{"metadata", {{"name", name}}}}; }

TEST(Resource, PathsNameGroupNamespaceObjectAndSubresource) {
  EXPECT_EQ(kPods.CollectionPath(), "/api/v1/namespaces/test/pods");
  EXPECT_EQ((Resource{"apps", "v1", "statefulsets", ""}).CollectionPath(), "/apis/apps/v1/statefulsets");
  EXPECT_EQ(kPods.Sub("status").ObjectPath("a").value(), "/api/v1/namespaces/test/pods/a/status");
  EXPECT_EQ(kPods.ObjectPath("../x?y").value(), "/api/v1/namespaces/test/pods/..%2Fx%3Fy");
  for (const char* name : {"", ".", ".."}) EXPECT_TRUE(absl::IsInvalidArgument(kPods.ObjectPath(name).status()));
  EXPECT_EQ(kPods.ApiVersion(), "v1");
  EXPECT_EQ(kWorlds.ApiVersion(), "aureole.example/v1");
}

TEST(ApiStatus, CodesAreThoseOfTheApisReasons) {
  struct Case {
    int code;
    const char* reason;
    StatusCode expected;
  };
  const Case cases[] = {{400, "BadRequest", StatusCode::kInvalidArgument},
                        {401, "Unauthorized", StatusCode::kUnauthenticated},
                        {403, "Forbidden", StatusCode::kPermissionDenied},
                        {404, "NotFound", StatusCode::kNotFound},
                        {405, "MethodNotAllowed", StatusCode::kUnimplemented},
                        {409, "AlreadyExists", StatusCode::kAlreadyExists},
                        {409, "Conflict", StatusCode::kAborted},
                        {410, "Expired", StatusCode::kOutOfRange},
                        {410, "Gone", StatusCode::kOutOfRange},
                        {415, "UnsupportedMediaType", StatusCode::kInvalidArgument},
                        {422, "Invalid", StatusCode::kInvalidArgument},
                        {429, "TooManyRequests", StatusCode::kUnavailable},
                        {500, "InternalError", StatusCode::kUnavailable},
                        {504, "Timeout", StatusCode::kUnavailable},
                        {302, "", StatusCode::kUnknown}};
  for (const Case& c : cases) {
    const absl::Status status = StatusOfReply("GET /x", c.code, {{"reason", c.reason}, {"message", "because"}});
    EXPECT_EQ(status.code(), c.expected) << c.code << c.reason;
    EXPECT_EQ(ReasonOf(status), c.reason);
  }
  const absl::Status status = StatusOfReply("GET /x", 404, {{"reason", "NotFound"}, {"message", "no x"}}, seconds(3));
  EXPECT_EQ(status.message(), "GET /x: 404 NotFound: no x");
  EXPECT_EQ(RetryAfterOf(status), seconds(3));
  EXPECT_EQ(RetryAfterOf(StatusOfReply("x", 504, {{"details", {{"retryAfterSeconds", 7}}}})), seconds(7));
  // A proxy's page has no fields at all.
  EXPECT_TRUE(absl::IsUnavailable(StatusOfReply("x", 502, Json("<html>"))));
  EXPECT_EQ(RetryAfterOf(StatusOfReply("x", 502, Json())), std::nullopt);
}

TEST(Backoff, PausesDoubleWithJitterUpToTheMost) {
  Backoff backoff(milliseconds(100), milliseconds(1000), 1);
  for (const int most : {100, 200, 400, 800, 1000, 1000}) {
    const auto pause = backoff.Next();
    EXPECT_GE(pause.count(), most / 2);
    EXPECT_LE(pause.count(), most);
  }
  backoff.Reset();
  EXPECT_LE(backoff.Next().count(), 100);
  EXPECT_NE(Backoff(milliseconds(1000), seconds(9), 1).Next(), Backoff(milliseconds(1000), seconds(9), 2).Next());
}

TEST(Backoff, PauseEndsAtOnceWhenStopped) {
  std::stop_source stop;
  EXPECT_TRUE(Pause(stop.get_token(), milliseconds(1)));
  const auto began = Clock::now();
  std::jthread stopper([&] { stop.request_stop(); });
  EXPECT_FALSE(Pause(stop.get_token(), seconds(60)));
  EXPECT_LT(Clock::now() - began, seconds(5));
}

class Api : public testing::Test {
 protected:
  FakeApiServer server_;
  ApiClient client_{server_.Access()};
};

TEST_F(Api, ObjectsAreCreatedReadReplacedAndDeleted) {
  const auto made = client_.Create(kPods, Named("a"));
  ASSERT_TRUE(made.ok()) << made.status();
  EXPECT_TRUE(absl::IsAlreadyExists(client_.Create(kPods, Named("a")).status()));
  Json first = client_.Get(kPods, "a").value();
  EXPECT_EQ(first, *made);
  first["spec"]["x"] = 1;
  ASSERT_TRUE(client_.Replace(kPods, first).ok());
  EXPECT_EQ(server_.At(absl::StrCat(kPodPath, "a"))->at("spec").at("x"), 1);
  // The version that was read is not the newest any more.
  EXPECT_TRUE(absl::IsAborted(client_.Replace(kPods, first).status()));
  EXPECT_TRUE(client_.Delete(kPods, "a").ok());
  EXPECT_TRUE(absl::IsNotFound(client_.Get(kPods, "a").status()));
  EXPECT_TRUE(absl::IsNotFound(client_.Delete(kPods, "a")));
}

TEST_F(Api, RequestsThatNameNoObjectAreNotSent) {
  server_.Put(absl::StrCat(kPodPath, "a"), Json::object());
  EXPECT_TRUE(absl::IsInvalidArgument(client_.Delete(kPods, "")));
  EXPECT_TRUE(absl::IsInvalidArgument(client_.Get(kPods, "").status()));
  EXPECT_TRUE(absl::IsInvalidArgument(client_.Patch(kPods, "", {.body = Json::object()}).status()));
  EXPECT_TRUE(absl::IsInvalidArgument(client_.Replace(kPods, Named("a")).status()));  // no version
  EXPECT_TRUE(absl::IsInvalidArgument(
      client_.Patch(kPods, "a", {.kind = Patch::Kind::kApply, .body = Json::object()}).status()));
  EXPECT_EQ(server_.Count(""), 0);
}

TEST_F(Api, PatchesMergeTestAndApply) {
  server_.Put(absl::StrCat(kPodPath, "a"), {{"spec", {{"x", 1}, {"y", 2}}}});
  ASSERT_TRUE(client_.Patch(kPods, "a", {.body = {{"spec", {{"x", nullptr}, {"z", 3}}}}}).ok());
  EXPECT_EQ(server_.At(absl::StrCat(kPodPath, "a"))->at("spec"), (Json{{"y", 2}, {"z", 3}}));
  const Json operations = Json::array(
      {{{"op", "test"}, {"path", "/spec/y"}, {"value", 2}}, {{"op", "replace"}, {"path", "/spec/y"}, {"value", 5}}});
  EXPECT_TRUE(client_.Patch(kPods, "a", {.kind = Patch::Kind::kJson, .body = operations}).ok());
  EXPECT_TRUE(
      absl::IsInvalidArgument(client_.Patch(kPods, "a", {.kind = Patch::Kind::kJson, .body = operations}).status()));
  const Patch apply{Patch::Kind::kApply, Json{{"apiVersion", "v1"}, {"kind", "Pod"}, {"metadata", {{"name", "b"}}}},
                    "aureole", true};
  EXPECT_TRUE(client_.Patch(kPods, "b", apply).ok());
  EXPECT_EQ(server_.Count("PATCH /api/v1/namespaces/test/pods/b?fieldManager=aureole&force=true"), 1);
}

TEST_F(Api, StatusIsWrittenThroughItsSubresourceOnly) {
  Json world = client_.Create(kWorlds, Named("w")).value();
  const Patch status{.body = {{"status", {{"phase", "Ready"}}}, {"spec", {{"regions", 9}}}}};
  ASSERT_TRUE(client_.Patch(kWorlds.Sub("status"), "w", status).ok());
  world = client_.Get(kWorlds, "w").value();
  EXPECT_EQ(TextAt(world, {"status", "phase"}), "Ready");
  EXPECT_EQ(Find(world, {"spec"}), nullptr);
}

TEST_F(Api, DeleteHoldsToItsPreconditions) {
  const Json pod = client_.Create(kPods, Named("a")).value();
  EXPECT_TRUE(absl::IsAborted(client_.Delete(kPods, "a", {.uid = "of-another"})));
  EXPECT_TRUE(absl::IsAborted(client_.Delete(kPods, "a", {.resource_version = "1"})));
  EXPECT_TRUE(client_.Delete(kPods, "a", {.uid = TextAt(pod, {"metadata", "uid"}), .grace_period_seconds = 0}).ok());
}

TEST_F(Api, ListFollowsItsPages) {
  for (int i = 0; i < 2 * ApiClient::kPage + 7; ++i) {
    server_.Put(absl::StrCat(kPodPath, "p", i), {{"metadata", {{"labels", {{"odd", i % 2 == 1 ? "yes" : "no"}}}}}});
  }
  const auto all = client_.List(kPods);
  ASSERT_TRUE(all.ok()) << all.status();
  EXPECT_EQ(all->items.size(), 2 * ApiClient::kPage + 7);
  EXPECT_EQ(server_.Count("GET"), 3);
  EXPECT_EQ(client_.List(kPods, {.labels = "odd=yes"})->items.size(), ApiClient::kPage + 3);
}

TEST_F(Api, ListWhosePagesAreForgottenBeginsAgain) {
  for (int i = 0; i < ApiClient::kPage + 1; ++i) server_.Put(absl::StrCat(kPodPath, "p", i), Json::object());
  server_.Inject({.kind = Kind::kStatus, .target = "continue=", .status = 410});
  const auto all = client_.List(kPods);
  ASSERT_TRUE(all.ok()) << all.status();
  EXPECT_EQ(all->items.size(), ApiClient::kPage + 1);
  EXPECT_EQ(server_.Count("GET"), 3);
}

// Each is met once, and the call then succeeds.
TEST_F(Api, RequestsThatMayBeRepeatedAreAfterEachFault) {
  server_.Put(absl::StrCat(kPodPath, "a"), Json::object());
  const Fault faults[] = {{.kind = Kind::kStatus, .status = 500},
                          {.kind = Kind::kStatus, .status = 503},
                          {.kind = Kind::kStatus, .status = 429},
                          {.kind = Kind::kStatus, .status = 408},
                          {.kind = Kind::kLostReply},
                          {.kind = Kind::kBrokenJson}};
  const CallOptions options;
  for (const char* method : {"GET", "PATCH"}) {
    for (Fault fault : faults) {
      fault.method = method;
      server_.Inject(fault);
      const auto reply = std::string(method) == "GET"
                             ? client_.Get(kPods, "a", options)
                             : client_.Patch(kPods, "a", {.body = {{"spec", {{"x", fault.status}}}}}, options);
      EXPECT_TRUE(reply.ok()) << method << fault.status << reply.status();
      EXPECT_EQ(server_.faults_left(), 0u);
    }
  }
  EXPECT_EQ(client_.stats().repeated, 12);
}

TEST_F(Api, WhatMightBeDoneTwiceIsNotRepeated) {
  server_.Inject({.kind = Kind::kStatus, .method = "POST", .status = 500});
  EXPECT_TRUE(absl::IsUnavailable(client_.Create(kPods, Named("a")).status()));
  server_.Inject({.kind = Kind::kLostReply, .method = "POST"});
  EXPECT_TRUE(absl::IsUnavailable(client_.Create(kPods, Named("b")).status()));
  EXPECT_TRUE(server_.At(absl::StrCat(kPodPath, "b")).has_value());
  // By its name only, the second try could meet a new object.
  server_.Inject({.kind = Kind::kLostReply, .method = "DELETE"});
  EXPECT_TRUE(absl::IsUnavailable(client_.Delete(kPods, "b")));
  EXPECT_FALSE(server_.At(absl::StrCat(kPodPath, "b")).has_value());
  const Json c = client_.Create(kPods, Named("c")).value();
  server_.Inject({.kind = Kind::kStatus, .method = "DELETE", .status = 503});
  EXPECT_TRUE(client_.Delete(kPods, "c", {.uid = TextAt(c, {"metadata", "uid"})}).ok());
  server_.Inject({.kind = Kind::kStatus, .method = "PATCH", .status = 500});
  server_.Put(absl::StrCat(kPodPath, "d"), Json::object());
  EXPECT_TRUE(
      absl::IsUnavailable(client_.Patch(kPods, "d", {.kind = Patch::Kind::kJson, .body = Json::array()}).status()));
  EXPECT_EQ(client_.stats().repeated, 1);
  // What was refused unread is: 429.
  server_.Inject({.kind = Kind::kStatus, .method = "POST", .status = 429});
  EXPECT_TRUE(client_.Create(kPods, Named("e")).ok());
}

TEST_F(Api, RetryAfterIsHonoured) {
  server_.Put(absl::StrCat(kPodPath, "a"), Json::object());
  server_.Inject({.kind = Kind::kStatus, .status = 429, .retry_after = 1});
  const auto began = Clock::now();
  EXPECT_TRUE(client_.Get(kPods, "a").ok());
  EXPECT_GE(Clock::now() - began, seconds(1));
  // Not when there is no time for it: then the caller is told.
  server_.Inject({.kind = Kind::kStatus, .status = 503, .retry_after = 40});
  const absl::Status status = client_.Get(kPods, "a").status();
  EXPECT_TRUE(absl::IsUnavailable(status));
  EXPECT_EQ(RetryAfterOf(status), seconds(40));
  EXPECT_LT(Clock::now() - began, seconds(20));
}

TEST_F(Api, RepetitionsAreBounded) {
  server_.Inject({.kind = Kind::kStatus, .times = 100, .status = 500});
  EXPECT_TRUE(absl::IsUnavailable(client_.Get(kPods, "a").status()));
  EXPECT_EQ(server_.Count("GET"), CallOptions().attempts);
}

TEST_F(Api, SlowAnswersAreUnavailableInTime) {
  server_.Inject({.kind = Kind::kHang, .times = 100});
  const auto began = Clock::now();
  const CallOptions options{.timeout = milliseconds(400), .attempt_timeout = milliseconds(150)};
  const absl::Status status = client_.Get(kPods, "a", options).status();
  EXPECT_TRUE(absl::IsUnavailable(status)) << status;
  EXPECT_LT(Clock::now() - began, seconds(2));
  EXPECT_GE(server_.Count("GET"), 2);
  server_.Release();
  EXPECT_TRUE(absl::IsNotFound(client_.Get(kPods, "a").status()));
}

TEST_F(Api, CallEndsAtOnceWhenStopped) {
  server_.Inject({.kind = Kind::kHang});
  std::stop_source stop;
  CallOptions options;
  options.stop = stop.get_token();
  absl::Status status;
  std::thread caller([&] { status = client_.Get(kPods, "a", options).status(); });
  ASSERT_TRUE(Await([&] { return server_.faults_left() == 0; }));
  const auto began = Clock::now();
  stop.request_stop();
  caller.join();
  EXPECT_LT(Clock::now() - began, milliseconds(500));
  EXPECT_TRUE(absl::IsCancelled(status)) << status;
}

TEST_F(Api, RefusedConnectionIsTriedAgain) {
  server_.Put(absl::StrCat(kPodPath, "a"), Json::object());
  server_.Stop();
  EXPECT_TRUE(absl::IsUnavailable(client_.Get(kPods, "a", {.attempts = 1}).status()));
  std::thread later([&] {
    ASSERT_TRUE(Await([&] { return client_.stats().repeated >= 2; }));
    server_.Start();
  });
  // Even a POST: surely nobody has seen it.
  const absl::Status status = client_.Create(kPods, Named("b"), {.attempts = 20}).status();
  later.join();
  EXPECT_TRUE(status.ok()) << status;
}

TEST_F(Api, ProxyOfTheEnvironmentIsNotAsked) {
  setenv("http_proxy", "http://127.0.0.1:9", 1);
  setenv("ALL_PROXY", "http://127.0.0.1:9", 1);
  EXPECT_TRUE(client_.Create(kPods, Named("a"), {.attempts = 1}).ok());
  unsetenv("http_proxy");
  unsetenv("ALL_PROXY");
}

TEST(ApiToken, ExpiredTokenIsReadAgainAndTheRequestRepeatedOnce) {
  std::string name = (std::filesystem::temp_directory_path() / "token.XXXXXX").string();
  const std::string file = std::string(mkdtemp(name.data())) + "/token";
  const auto write = [&](const std::string& token) { std::ofstream(file) << token; };
  write("old");
  FakeApiServer server;
  ClusterAccess access = server.Access();
  access.token_file = file;
  ApiClient client(access);
  server.AcceptOnly("old");
  EXPECT_TRUE(client.Create(kPods, Named("a")).ok());
  server.AcceptOnly("new");
  const absl::Status status = client.Get(kPods, "a").status();
  EXPECT_TRUE(absl::IsUnauthenticated(status)) << status;
  EXPECT_EQ(server.Count("GET"), 1);  // the same token again would not help
  write("new");
  EXPECT_TRUE(client.Get(kPods, "a").ok());
  EXPECT_EQ(server.Count("GET"), 3);
  EXPECT_EQ(client.stats().tokens_renewed, 1);
  write("wrong");
  server.AcceptOnly("newer");
  EXPECT_TRUE(absl::IsUnauthenticated(client.Get(kPods, "a").status()));
  EXPECT_EQ(server.Count("GET"), 5);
  std::filesystem::remove_all(std::filesystem::path(file).parent_path());
}

TEST(ApiTls, ServerAndClientProveWhoTheyAre) {
  const TlsKeys keys = MakeTlsKeys(), other = MakeTlsKeys("127.0.0.1", "another"), namesake = MakeTlsKeys();
  FakeApiServer server(&keys);
  EXPECT_TRUE(ApiClient(server.Access()).Create(kPods, Named("a")).ok());
  // A server whose certificate is not of our authority, though it may be one that the system trusts.
  ClusterAccess distrusts = server.Access();
  distrusts.ca = other.ca;
  const absl::Status status = ApiClient(distrusts).Get(kPods, "a").status();
  EXPECT_TRUE(absl::IsFailedPrecondition(status)) << status;
  distrusts.ca = namesake.ca;
  const absl::Status of_namesake = ApiClient(distrusts).Get(kPods, "a", {.attempts = 1}).status();
  EXPECT_TRUE(absl::StrContains(of_namesake.message(), "is the CA that of this server?")) << of_namesake;
  ClusterAccess nobody = server.Access();
  nobody.client_certificate.clear();
  nobody.client_key.clear();
  EXPECT_FALSE(ApiClient(nobody).Get(kPods, "a", {.attempts = 1}).ok());
  ClusterAccess stranger = server.Access();
  stranger.client_certificate = other.client_certificate;
  stranger.client_key = other.client_key;
  EXPECT_FALSE(ApiClient(stranger).Get(kPods, "a", {.attempts = 1}).ok());
  EXPECT_EQ(server.Count("GET"), 0);
}

TEST(ApiTls, CertificateOfAnotherAddressIsRefused) {
  const TlsKeys keys = MakeTlsKeys("127.0.0.2");
  FakeApiServer server(&keys);
  const absl::Status status = ApiClient(server.Access()).Get(kPods, "a").status();
  EXPECT_TRUE(absl::IsFailedPrecondition(status)) << status;
}

}  // namespace
}  // namespace aureole::kubernetes
