// The copy follows the server whatever happens to the way between them. The faults, one test each:
//
//   of a watch: cut in the middle of a line, and between lines; 410 as HTTP status and as ERROR event; other ERROR
//     events, passing and lasting; a line that is not JSON; 500, 503, 429 with Retry-After, 403; a slow answer, none at
//     all, and a watch that falls silent; an expired token (401) until its file is read again
//   of a list: 500, 429 with Retry-After, a body and a JSON text that end too early
//   of the server: not there for a while; history forgotten while nobody watched
#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <set>

#include <absl/strings/str_cat.h>

#include "server/control/kubernetes/reflector.h"
#include "tests/kubernetes/await.h"
#include "tests/kubernetes/fake_api_server.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using Clock = std::chrono::steady_clock;
using Kind = Fault::Kind;

const Resource kPods{"", "v1", "pods", "test"};
constexpr char kCollection[] = "/api/v1/namespaces/test/pods";

std::string PathOf(int i) { return absl::StrCat(kCollection, "/p", i); }

// A copy made of the changes alone, as a reconcile loop might hold one.
class Follower {
 public:
  void Take(Reflector& reflector) {
    for (const Change& change : reflector.Take()) {
      const std::string uid = TextAt(*change.object, {"metadata", "uid"});
      switch (change.kind) {
        case Change::Kind::kAdded:
          EXPECT_TRUE(objects_.emplace(uid, *change.object).second) << "added twice: " << uid;
          break;
        case Change::Kind::kModified:
          EXPECT_TRUE(objects_.contains(uid)) << "modified, but never added: " << uid;
          objects_[uid] = *change.object;
          break;
        case Change::Kind::kDeleted:
          EXPECT_EQ(objects_.erase(uid), 1u) << "deleted, but never added: " << uid;
          break;
      }
    }
  }
  std::set<std::string> versions() const {
    std::set<std::string> out;
    for (const auto& [uid, object] : objects_) out.insert(TextAt(object, {"metadata", "resourceVersion"}));
    return out;
  }

 private:
  std::map<std::string, Json> objects_;
};

class Reflecting {
 public:
  explicit Reflecting(FakeApiServer* server, ClusterAccess access)
      : server_(server),
        client_(std::move(access)),
        reflector_(&client_, {.resource = kPods, .first_pause = milliseconds(5), .longest_pause = milliseconds(50)},
                   &wakeup_) {}
  explicit Reflecting(FakeApiServer* server) : Reflecting(server, server->Access()) {}

  // Until the objects and the sum of all changes are what the server has.
  bool AwaitEqual() {
    std::set<std::string> wanted;
    for (const Json& object : server_->All(kCollection)) wanted.insert(TextAt(object, {"metadata", "resourceVersion"}));
    return Await([&] {
      follower_.Take(reflector_);
      std::set<std::string> held;
      for (const auto& [key, object] : reflector_.objects())
        held.insert(TextAt(*object, {"metadata", "resourceVersion"}));
      return reflector_.synced() && held == wanted && follower_.versions() == wanted;
    });
  }
  bool AwaitWatch() {
    return Await([&] { return server_->watches() == 1 && reflector_.health().ok(); });
  }
  Reflector& reflector() { return reflector_; }
  Wakeup& wakeup() { return wakeup_; }

 private:
  FakeApiServer* const server_;
  ApiClient client_;
  Wakeup wakeup_;
  Reflector reflector_;
  Follower follower_;
};

// Adds, changes and removes; no two rounds are alike.
void Stir(FakeApiServer& server, int round) {
  server.Put(PathOf(round + 10), {{"spec", {{"round", round}}}});
  server.Put(PathOf(0), {{"spec", {{"round", round}}}});
  if (round % 2 == 1) {  // the name gets a new owner
    server.Remove(PathOf(1));
    server.Put(PathOf(1), {{"spec", {{"round", round}}}});
  }
  server.Remove(PathOf(round + 9));
}

TEST(Reflector, ListsThenFollowsEveryChange) {
  FakeApiServer server;
  for (int i = 0; i < 5; ++i) server.Put(PathOf(i), Json::object());
  Reflecting r(&server);
  ASSERT_TRUE(r.AwaitEqual());
  for (int round = 1; round <= 20; ++round) {
    Stir(server, round);
    ASSERT_TRUE(r.AwaitEqual()) << round;
  }
  EXPECT_EQ(r.reflector().stats().lists, 1);
  EXPECT_EQ(r.reflector().stats().watches, 1);
  EXPECT_TRUE(r.reflector().health().ok());
  EXPECT_TRUE(r.wakeup().Wait(seconds(20)));
}

TEST(Reflector, NothingIsToldBeforeTheFirstList) {
  FakeApiServer server;
  server.Put(PathOf(0), Json::object());
  server.Inject({.kind = Kind::kHang});
  Reflecting r(&server);
  ASSERT_TRUE(Await([&] { return server.faults_left() == 0; }));
  EXPECT_FALSE(r.reflector().synced());
  EXPECT_FALSE(r.reflector().health().ok());
  EXPECT_TRUE(r.reflector().Take().empty());
  server.Release();
  EXPECT_TRUE(r.AwaitEqual());
}

struct FaultCase {
  const char* name;
  Fault fault;
  bool lists_again;  // true: it must; false: it must go on from where it was
};
void PrintTo(const FaultCase& tested, std::ostream* out) { *out << tested.name; }

class ReflectorFault : public testing::TestWithParam<FaultCase> {};

// The watch is cut, and the fault meets what comes next, while objects come, change and go.
TEST_P(ReflectorFault, CopyConverges) {
  FakeApiServer server;
  for (int i = 0; i < 3; ++i) server.Put(PathOf(i), Json::object());
  Reflecting r(&server);
  ASSERT_TRUE(r.AwaitEqual() && r.AwaitWatch());
  server.Inject(GetParam().fault);
  server.CutWatches();
  for (int round = 1; round <= 4; ++round) Stir(server, round);
  ASSERT_TRUE(Await([&] { return server.faults_left() == 0; })) << "the fault was not met";
  if (GetParam().fault.kind == Kind::kHang) server.Release();
  for (int round = 5; round <= 8; ++round) Stir(server, round);
  ASSERT_TRUE(r.AwaitEqual()) << r.reflector().health();
  ASSERT_TRUE(r.AwaitWatch()) << r.reflector().health();
  EXPECT_EQ(r.reflector().stats().lists > 1, GetParam().lists_again);
  EXPECT_EQ(server.watches(), 1);
}

Fault OfWatch(Fault fault) {
  fault.target = "watch=1";
  return fault;
}

INSTANTIATE_TEST_SUITE_P(
    All, ReflectorFault,
    testing::Values(
        FaultCase{"CutInTheMiddleOfALine", OfWatch({.kind = Kind::kHalfLine, .times = 3}), false},
        FaultCase{"GoneByHttpStatus", OfWatch({.kind = Kind::kStatus, .times = 2, .status = 410}), true},
        FaultCase{"GoneByErrorEvent", OfWatch({.kind = Kind::kGoneEvent, .times = 2}), true},
        FaultCase{"OtherErrorEvent", OfWatch({.kind = Kind::kErrorEvent, .status = 422}), true},
        FaultCase{"ServerErrorEvent", OfWatch({.kind = Kind::kErrorEvent, .status = 500}), false},
        FaultCase{"ServerErrorEventThatLasts",
                  OfWatch({.kind = Kind::kErrorEvent, .times = Reflector::kMostFailures, .status = 500}), true},
        FaultCase{"LineThatIsNotJson", OfWatch({.kind = Kind::kGarbageLine}), true},
        FaultCase{"Status500", OfWatch({.kind = Kind::kStatus, .times = 3, .status = 500}), false},
        FaultCase{"Status503", OfWatch({.kind = Kind::kStatus, .times = 3, .status = 503}), false},
        FaultCase{"Status429WithRetryAfter", OfWatch({.kind = Kind::kStatus, .status = 429, .retry_after = 1}), false},
        FaultCase{"Forbidden", OfWatch({.kind = Kind::kStatus, .status = 403}), false},
        FaultCase{"SlowAnswer", OfWatch({.kind = Kind::kSlow, .delay = milliseconds(300)}), false},
        FaultCase{"HangingAnswer", OfWatch({.kind = Kind::kHang}), false}),
    [](const auto& tested) { return std::string(tested.param.name); });

// What a list meets is met at the start.
class ReflectorListFault : public testing::TestWithParam<FaultCase> {};

TEST_P(ReflectorListFault, CopyConverges) {
  FakeApiServer server;
  for (int i = 0; i < 3; ++i) server.Put(PathOf(i), Json::object());
  server.Inject(GetParam().fault);
  Reflecting r(&server);
  ASSERT_TRUE(r.AwaitEqual()) << r.reflector().health();
  EXPECT_EQ(server.faults_left(), 0u);
  EXPECT_GE(r.reflector().stats().failures, 1);
}

INSTANTIATE_TEST_SUITE_P(
    All, ReflectorListFault,
    testing::Values(FaultCase{"Status500", {.kind = Kind::kStatus, .times = 3, .status = 500}, true},
                    FaultCase{
                        "Status429WithRetryAfter", {.kind = Kind::kStatus, .status = 429, .retry_after = 1}, true},
                    FaultCase{"TruncatedBody", {.kind = Kind::kLostReply, .times = 2}, true},
                    FaultCase{"TruncatedJson", {.kind = Kind::kBrokenJson, .times = 2}, true}),
    [](const auto& tested) { return std::string(tested.param.name); });

TEST(Reflector, GoesOnAfterCutsWithoutListingAgain) {
  FakeApiServer server;
  server.Put(PathOf(0), Json::object());
  Reflecting r(&server);
  ASSERT_TRUE(r.AwaitEqual());
  for (int round = 1; round <= 10; ++round) {
    ASSERT_TRUE(r.AwaitWatch());
    server.CutWatches();
    Stir(server, round);
    ASSERT_TRUE(r.AwaitEqual()) << round;
  }
  EXPECT_EQ(r.reflector().stats().lists, 1);
}

TEST(Reflector, WhatWasDeletedWhileHistoryWasForgottenIsReported) {
  FakeApiServer server;
  for (int i = 0; i < 5; ++i) server.Put(PathOf(i), Json::object());
  Reflecting r(&server);
  ASSERT_TRUE(r.AwaitEqual() && r.AwaitWatch());
  server.Inject({.kind = Kind::kHang, .target = "watch=1"});
  server.CutWatches();
  ASSERT_TRUE(Await([&] { return server.faults_left() == 0; }));
  server.Remove(PathOf(2));
  server.Remove(PathOf(4));
  server.Put(PathOf(4), {{"spec", "another"}});
  server.ForgetHistory();
  server.Release();
  ASSERT_TRUE(r.AwaitEqual()) << r.reflector().health();
  EXPECT_EQ(r.reflector().stats().gone, 1);
  EXPECT_EQ(r.reflector().stats().lists, 2);
}

TEST(Reflector, BookmarkKeepsAQuietWatchFromBeingForgotten) {
  FakeApiServer server;
  server.Put(PathOf(0), Json::object());
  Reflecting r(&server);
  ASSERT_TRUE(r.AwaitEqual() && r.AwaitWatch());
  server.Put("/api/v1/namespaces/other/pods/x", Json::object());  // nothing of ours
  server.ForgetHistory();
  server.SendBookmarks();
  ASSERT_TRUE(Await([&] { return r.reflector().stats().bookmarks == 1; }));
  server.CutWatches();
  Stir(server, 1);
  ASSERT_TRUE(r.AwaitEqual());
  EXPECT_EQ(r.reflector().stats().lists, 1);
  EXPECT_EQ(r.reflector().stats().gone, 0);
}

TEST(Reflector, SurvivesAServerThatIsAwayForAWhile) {
  FakeApiServer server;
  for (int i = 0; i < 3; ++i) server.Put(PathOf(i), Json::object());
  Reflecting r(&server);
  ASSERT_TRUE(r.AwaitEqual() && r.AwaitWatch());
  server.Stop();
  const int64_t failures = r.reflector().stats().failures;
  Stir(server, 1);
  ASSERT_TRUE(Await([&] { return r.reflector().stats().failures >= failures + 3; }));
  EXPECT_FALSE(r.reflector().health().ok());
  EXPECT_EQ(r.reflector().objects().size(), 3u);  // the last that is known
  server.Start();
  ASSERT_TRUE(r.AwaitEqual()) << r.reflector().health();
  EXPECT_TRUE(r.AwaitWatch()) << r.reflector().health();
}

TEST(Reflector, WatchThatTheServerEndsInTimeIsTakenUp) {
  FakeApiServer server;
  server.Put(PathOf(0), Json::object());
  ApiClient client(server.Access());
  Wakeup wakeup;
  Reflector reflector(&client, {.resource = kPods, .watch_timeout = seconds(1)}, &wakeup);
  ASSERT_TRUE(Await([&] { return reflector.stats().watches == 3; }));
  EXPECT_EQ(reflector.stats().failures, 0);
  EXPECT_EQ(reflector.stats().lists, 1);
}

TEST(Reflector, SilentServerIsGivenUp) {
  FakeApiServer server;
  ApiClient client(server.Access());
  Wakeup wakeup;
  const std::pair<Kind, seconds> cases[] = {{Kind::kHang, seconds(300)}, {Kind::kMute, seconds(1)}};
  for (const auto& [kind, timeout] : cases) {  // before the reply, and within
    server.Remove(PathOf(0));
    server.Inject({.kind = kind, .target = "watch=1"});
    Reflector reflector(&client, {.resource = kPods, .watch_timeout = timeout, .watch_grace = milliseconds(200)},
                        &wakeup);
    ASSERT_TRUE(Await([&] { return reflector.synced() && server.faults_left() == 0; }));
    server.Put(PathOf(0), Json::object());
    EXPECT_TRUE(Await([&] { return reflector.objects().size() == 1; })) << reflector.health();
    EXPECT_EQ(reflector.stats().failures, 1);
  }
  server.Release();
}

TEST(Reflector, EventsOfAnySizeArriveWhole) {
  FakeApiServer server;
  Reflecting r(&server);
  ASSERT_TRUE(r.AwaitEqual() && r.AwaitWatch());
  for (int i = 0; i < 20; ++i) {
    server.Put(PathOf(i), {{"spec", std::string(size_t{1} << i, static_cast<char>('a' + i))}});
  }
  ASSERT_TRUE(r.AwaitEqual()) << r.reflector().health();
  EXPECT_EQ(r.reflector().stats().failures, 0);
  for (const Json& object : server.All(kCollection)) {
    EXPECT_EQ(*r.reflector().objects()["test/" + TextAt(object, {"metadata", "name"})], object);
  }
}

TEST(Reflector, GoesOnWhenAnExpiredTokenIsReplaced) {
  std::string directory = (std::filesystem::temp_directory_path() / "token.XXXXXX").string();
  const std::string file = std::string(mkdtemp(directory.data())) + "/token";
  const auto write = [&](const std::string& token) { std::ofstream(file) << token; };
  write("old");
  FakeApiServer server;
  server.AcceptOnly("old");
  ClusterAccess access = server.Access();
  access.token_file = file;
  {
    Reflecting r(&server, access);
    ASSERT_TRUE(r.AwaitEqual() && r.AwaitWatch());
    server.AcceptOnly("new");
    server.CutWatches();
    Stir(server, 1);
    ASSERT_TRUE(Await([&] { return absl::IsUnauthenticated(r.reflector().health()); }));
    write("new");
    ASSERT_TRUE(r.AwaitEqual()) << r.reflector().health();
  }
  std::filesystem::remove_all(directory);
}

TEST(Reflector, StopsAtOnceWithinAHangingRead) {
  FakeApiServer server;
  for (const bool listing : {true, false}) {
    if (listing) server.Inject({.kind = Kind::kHang});
    Reflecting r(&server);
    ASSERT_TRUE(listing ? Await([&] { return server.faults_left() == 0; }) : r.AwaitWatch());
    const auto began = Clock::now();
    r.reflector().Stop();
    EXPECT_LT(Clock::now() - began, milliseconds(500));
    server.Release();
  }
}

TEST(Reflector, SelectsByLabels) {
  FakeApiServer server;
  const Json ours = {{"metadata", {{"labels", {{"app", "aureole"}}}}}};
  server.Put(PathOf(0), ours);
  server.Put(PathOf(1), Json::object());
  ApiClient client(server.Access());
  Wakeup wakeup;
  Reflector reflector(&client, {.resource = kPods, .selection = {.labels = "app=aureole"}}, &wakeup);
  ASSERT_TRUE(Await([&] { return server.watches() == 1; }));
  server.Put(PathOf(2), Json::object());
  server.Put(PathOf(3), ours);
  ASSERT_TRUE(Await([&] { return reflector.objects().size() == 2; }));
  EXPECT_TRUE(reflector.objects().contains("test/p0") && reflector.objects().contains("test/p3"));
}

}  // namespace
}  // namespace aureole::kubernetes
