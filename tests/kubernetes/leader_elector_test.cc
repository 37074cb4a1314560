// Electors with a server and a clock between them, in this process and in others that are frozen and killed.
#include <gtest/gtest.h>

#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstdio>

#include "server/control/kubernetes/leader_elector.h"
#include "tests/kubernetes/await.h"
#include "tests/kubernetes/fake_api_server.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using Clock = std::chrono::steady_clock;

constexpr char kLease[] = "/apis/coordination.k8s.io/v1/namespaces/test/leases/leader";
constexpr ElectionTiming kTiming{milliseconds(1000), milliseconds(600), milliseconds(50)};

class Candidate {
 public:
  Candidate(const FakeApiServer& server, const std::string& name)
      : client_(server.Access()), elector_(&client_, {"test", "leader", name, kTiming}, &wakeup_) {}
  bool AwaitLeading() {
    return Await([&] { return elector_.Epoch().has_value(); });
  }
  LeaderElector& elector() { return elector_; }
  Wakeup& wakeup() { return wakeup_; }

 private:
  ApiClient client_;
  Wakeup wakeup_;
  LeaderElector elector_;
};

// A process of its own (elector_main.cc).
class Process {
 public:
  Process(const FakeApiServer& server, const std::string& name) {
    int in[2], out[2];
    EXPECT_EQ(pipe(in), 0);
    EXPECT_EQ(pipe(out), 0);
    const std::string url = server.url();
    pid_ = fork();
    if (pid_ == 0) {
      dup2(in[0], 0);
      dup2(out[1], 1);
      for (int i = 3; i < 256; ++i) close(i);
      execl(AUREOLE_ELECTOR, "elector", url.c_str(), name.c_str(), "1000", "600", "50", nullptr);
      _exit(127);
    }
    close(in[0]);
    close(out[1]);
    ask_ = in[1];
    answers_ = fdopen(out[0], "r");
  }
  ~Process() {
    Signal(SIGCONT);
    Signal(SIGKILL);
    waitpid(pid_, nullptr, 0);
    close(ask_);
    fclose(answers_);
  }
  void Signal(int number) const { kill(pid_, number); }
  // The epoch, or "none".
  std::string Ask() {
    char line[64] = "";
    EXPECT_EQ(write(ask_, "\n", 1), 1);
    EXPECT_NE(fgets(line, sizeof line, answers_), nullptr);
    return std::string(line).substr(0, std::string(line).find('\n'));
  }

 private:
  pid_t pid_ = 0;
  int ask_ = -1;
  FILE* answers_ = nullptr;
};

TEST(LeaderElector, OneOfTwoLeadsAndHandsOverAtOnceWhenItStops) {
  FakeApiServer server;
  Candidate a(server, "a");
  ASSERT_TRUE(a.AwaitLeading());
  EXPECT_EQ(a.elector().Epoch(), 1);
  EXPECT_TRUE(a.wakeup().Wait(seconds(20)));
  Candidate b(server, "b");
  ASSERT_TRUE(Await([&] { return b.elector().holder() == a.elector().identity(); }));
  EXPECT_EQ(b.elector().Epoch(), std::nullopt);
  const auto began = Clock::now();
  a.elector().Stop();
  EXPECT_EQ(a.elector().Epoch(), std::nullopt);
  ASSERT_TRUE(b.AwaitLeading());
  EXPECT_LT(Clock::now() - began, kTiming.duration);  // without waiting for it to expire
  EXPECT_EQ(b.elector().Epoch(), 2);
  EXPECT_EQ(LeaseOf(*server.At(kLease)).holder, b.elector().identity());
}

TEST(LeaderElector, RenewsAndKeepsWhatOthersWroteIntoTheLease) {
  FakeApiServer server;
  Candidate a(server, "a");
  ASSERT_TRUE(a.AwaitLeading());
  Json lease = *server.At(kLease);
  lease["metadata"]["labels"] = {{"x", "y"}};  // another's write: the next renewal conflicts
  server.Put(kLease, lease);
  const std::string renewed = LeaseOf(lease).renewed;
  ASSERT_TRUE(Await([&] { return LeaseOf(*server.At(kLease)).renewed > renewed; }));
  EXPECT_EQ(TextAt(*server.At(kLease), {"metadata", "labels", "x"}), "y");
  EXPECT_EQ(a.elector().Epoch(), 1);
}

TEST(LeaderElector, LeaderWithoutAServerStopsBeforeAnotherMayBegin) {
  FakeApiServer server;
  Candidate a(server, "a");
  ASSERT_TRUE(a.AwaitLeading());
  for (const char* method : {"GET", "PUT"}) {
    server.Inject({.kind = Fault::Kind::kHang, .method = method, .times = 1000});
  }
  const auto began = Clock::now();
  while (a.wakeup().Wait(milliseconds(0))) {
  }
  EXPECT_TRUE(a.wakeup().Wait(seconds(20)));  // told, though a request hangs
  EXPECT_EQ(a.elector().Epoch(), std::nullopt);
  EXPECT_LT(Clock::now() - began, kTiming.duration);
  ASSERT_TRUE(Await([&] { return !a.elector().health().ok(); }));
  server.Release();
  ASSERT_TRUE(a.AwaitLeading());
  EXPECT_EQ(a.elector().Epoch(), 2);
}

struct LeaseFault {
  const char* name;
  Fault fault;
};
void PrintTo(const LeaseFault& tested, std::ostream* out) { *out << tested.name; }

class LeaderElectorFault : public testing::TestWithParam<LeaseFault> {};

// A fault that is shorter than the deadline costs nothing: neither the lease nor the epoch.
TEST_P(LeaderElectorFault, LeaderKeepsItsEpoch) {
  FakeApiServer server;
  Candidate a(server, "a");
  ASSERT_TRUE(a.AwaitLeading());
  server.Inject(GetParam().fault);
  ASSERT_TRUE(Await([&] { return server.faults_left() == 0; }));
  const std::string renewed = LeaseOf(*server.At(kLease)).renewed;
  ASSERT_TRUE(Await([&] { return LeaseOf(*server.At(kLease)).renewed > renewed; }));
  EXPECT_EQ(a.elector().Epoch(), 1);
}

INSTANTIATE_TEST_SUITE_P(
    All, LeaderElectorFault,
    testing::Values(LeaseFault{"Conflict", {.kind = Fault::Kind::kStatus, .method = "PUT", .status = 409}},
                    LeaseFault{"Status500", {.kind = Fault::Kind::kStatus, .method = "PUT", .times = 2, .status = 500}},
                    LeaseFault{"Status429", {.kind = Fault::Kind::kStatus, .method = "PUT", .status = 429}},
                    LeaseFault{"LostReply", {.kind = Fault::Kind::kLostReply, .method = "PUT"}},
                    LeaseFault{"TruncatedJson", {.kind = Fault::Kind::kBrokenJson, .method = "PUT"}},
                    LeaseFault{"Forbidden", {.kind = Fault::Kind::kStatus, .method = "PUT", .status = 403}}),
    [](const auto& tested) { return std::string(tested.param.name); });

TEST(LeaderElector, ServerThatIsAwayForAWhileIsSurvived) {
  FakeApiServer server;
  Candidate a(server, "a");
  ASSERT_TRUE(a.AwaitLeading());
  server.Stop();
  ASSERT_TRUE(Await([&] { return !a.elector().Epoch(); }));
  server.Start();
  ASSERT_TRUE(a.AwaitLeading());
  EXPECT_EQ(a.elector().Epoch(), 2);
}

TEST(LeaderElector, KilledLeaderIsFollowedWithinTheLease) {
  FakeApiServer server;
  Process leader(server, "a");
  ASSERT_TRUE(Await([&] { return leader.Ask() == "1"; }));
  Candidate b(server, "b");
  ASSERT_TRUE(Await([&] { return !b.elector().holder().empty(); }));
  const auto began = Clock::now();
  leader.Signal(SIGKILL);
  ASSERT_TRUE(b.AwaitLeading());
  const auto took = Clock::now() - began;
  EXPECT_EQ(b.elector().Epoch(), 2);
  EXPECT_GE(took, kTiming.duration - 2 * kTiming.retry);
  EXPECT_LT(took, kTiming.duration + seconds(2));  // and the time of a loaded machine
}

TEST(LeaderElector, FrozenLeaderIsFollowedAndKnowsAtOnceWhenItWakes) {
  FakeApiServer server;
  Process leader(server, "a");
  ASSERT_TRUE(Await([&] { return leader.Ask() == "1"; }));
  Candidate b(server, "b");
  leader.Signal(SIGSTOP);
  ASSERT_TRUE(b.AwaitLeading());
  EXPECT_EQ(b.elector().Epoch(), 2);
  leader.Signal(SIGCONT);
  EXPECT_EQ(leader.Ask(), "none");
  EXPECT_EQ(b.elector().Epoch(), 2);
}

TEST(LeaderElector, StopsInTimeThoughTheServerHangs) {
  FakeApiServer server;
  Candidate a(server, "a");
  ASSERT_TRUE(a.AwaitLeading());
  for (const char* method : {"GET", "PUT"}) {
    server.Inject({.kind = Fault::Kind::kHang, .method = method, .times = 1000});
  }
  const auto began = Clock::now();
  a.elector().Stop();
  EXPECT_LT(Clock::now() - began, LeaderElector::kReleaseTimeout + seconds(1));
  server.Release();
}

}  // namespace
}  // namespace aureole::kubernetes
