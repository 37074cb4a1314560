// The decision who leads, step by step on clocks of the test.
#include <gtest/gtest.h>

#include <random>
#include <vector>

#include "server/control/kubernetes/leader_election.h"

namespace aureole::kubernetes {
namespace {

using Action = LeaderElection::Action;
using std::chrono::milliseconds;
using std::chrono::seconds;
using Time = LeaderElection::Time;

Time At(double s) { return Time(std::chrono::duration_cast<Time::duration>(std::chrono::duration<double>(s))); }

// The lease on the server; a version stands for its resourceVersion.
struct Server {
  std::optional<Lease> lease;
  int version = 0;
  int clock = 0;
};

// An elector whose requests take no time unless the test says so.
class Elector {
 public:
  Elector(Server* server, const std::string& name) : server_(server), election_(name, ElectionTiming()) {}

  // Does all that is to do at `now`. Offline: every request fails.
  void Run(double now, bool online = true) {
    for (int i = 0; i < 10; ++i) {
      const LeaderElection::Step step = election_.Next(At(now));
      if (step.action == Action::kWait) return;
      if (!online) {
        election_.Failed(At(now));
      } else if (step.action == Action::kRead) {
        version_ = server_->version;
        election_.Read(At(now), server_->lease);
      } else {
        Write(step, now, now);
      }
    }
    FAIL() << "does not come to rest";
  }
  void Write(const LeaderElection::Step& step, double sent, double now) {
    const bool creates = step.action == Action::kCreate;
    if (creates ? server_->lease.has_value() : (!server_->lease || server_->version != version_)) {
      election_.Refused(At(now));
      return;
    }
    Lease lease = step.lease;
    lease.renewed = std::to_string(++server_->clock);
    if (lease.acquired.empty()) lease.acquired = lease.renewed;
    server_->lease = lease;
    version_ = ++server_->version;
    election_.Written(At(sent), At(now), lease);
  }
  std::optional<int64_t> Epoch(double now) const { return election_.Epoch(At(now)); }
  LeaderElection& election() { return election_; }

 private:
  Server* const server_;
  int version_ = 0;
  LeaderElection election_;
};

TEST(LeaderElection, TimingIsCheckedWithItsField) {
  EXPECT_TRUE(CheckTiming({}).ok());
  const auto message = [](int duration, int deadline, int retry) {
    return std::string(CheckTiming({milliseconds(duration), milliseconds(deadline), milliseconds(retry)}).message());
  };
  EXPECT_EQ(message(15, 10, 0), "retry: is 0 ms, must be more than 0 ms");
  EXPECT_EQ(message(15, 10, 10), "retry: is 10 ms, must be less than the renew deadline of 10 ms");
  EXPECT_EQ(message(10, 10, 2), "renew_deadline: is 10 ms, must be less than the duration of 10 ms");
}

TEST(LeaderElection, FirstCandidateCreatesTheLeaseAndLeads) {
  Server server;
  Elector a(&server, "a");
  EXPECT_EQ(a.Epoch(0), std::nullopt);
  a.Run(0);
  EXPECT_EQ(a.Epoch(0), 1);
  EXPECT_EQ(server.lease->holder, "a");
  EXPECT_EQ(server.lease->transitions, 1);
  EXPECT_EQ(server.lease->duration, seconds(15));
  EXPECT_EQ(server.lease->acquired, server.lease->renewed);
}

TEST(LeaderElection, LeaderRenewsEveryTwoSecondsAndKeepsItsEpoch) {
  Server server;
  Elector a(&server, "a");
  for (int half = 0; half <= 60; ++half) a.Run(half * 0.5);
  EXPECT_EQ(server.version, 16);
  EXPECT_EQ(a.Epoch(30), 1);
  EXPECT_EQ(server.lease->acquired, "1");
  EXPECT_EQ(server.lease->renewed, "16");
}

TEST(LeaderElection, CandidateWaitsForTheDurationSinceItSawTheLastChange) {
  Server server;
  Elector a(&server, "a"), b(&server, "b");
  a.Run(0);
  b.Run(1);  // sees it first here
  for (double now = 1; now < 15.9; now += 0.25) {
    b.Run(now);
    EXPECT_EQ(b.Epoch(now), std::nullopt) << now;
  }
  b.Run(16);
  EXPECT_EQ(b.Epoch(16), 2);
  EXPECT_EQ(server.lease->holder, "b");
}

TEST(LeaderElection, WallClockTimesInTheLeaseAreOfNoMeaning) {
  Server server;
  server.lease = {"old", 7, seconds(15), "1970-01-01T00:00:00.000000Z", "1970-01-01T00:00:00.000000Z"};
  Elector b(&server, "b");
  b.Run(0);
  b.Run(14.9);
  EXPECT_EQ(b.Epoch(14.9), std::nullopt);
  b.Run(15);
  EXPECT_EQ(b.Epoch(15), 8);
}

TEST(LeaderElection, LongerDurationOfTheHolderIsWaitedFor) {
  Server server;
  server.lease = {"old", 7, seconds(60), "", ""};
  Elector b(&server, "b");
  for (int now = 0; now < 60; ++now) b.Run(now);
  EXPECT_EQ(b.Epoch(59), std::nullopt);
  b.Run(60);
  EXPECT_EQ(b.Epoch(60), 8);
}

TEST(LeaderElection, WithoutRenewalTheLeaderMayNotActAfterTheDeadline) {
  Server server;
  Elector a(&server, "a");
  a.Run(0);
  for (double now = 2; now < 10; now += 0.5) a.Run(now, false);
  EXPECT_EQ(a.Epoch(9.999), 1);
  EXPECT_EQ(a.Epoch(10), std::nullopt);
  a.Run(10, false);
  // It was away, but nobody took the lease: leads again, in a new epoch.
  a.Run(12);
  EXPECT_EQ(a.Epoch(12), 2);
}

TEST(LeaderElection, DeadlineCountsFromWhenTheRenewalWasSent) {
  Server server;
  Elector a(&server, "a");
  a.Run(0);
  const auto step = a.election().Next(At(2));
  ASSERT_EQ(step.action, Action::kReplace);
  a.Write(step, 2, 9);  // the answer took 7 s
  EXPECT_EQ(a.Epoch(11.9), 1);
  EXPECT_EQ(a.Epoch(12), std::nullopt);
}

TEST(LeaderElection, RenewalThatArrivesAfterTheDeadlineBeginsANewEpoch) {
  Server server;
  Elector a(&server, "a");
  a.Run(0);
  const auto step = a.election().Next(At(2));
  a.Write(step, 2, 10.5);  // since 10 it has been no leader
  EXPECT_EQ(a.Epoch(10.5), std::nullopt);
  a.Run(10.5);
  EXPECT_EQ(a.Epoch(10.5), 2);
}

TEST(LeaderElection, FrozenLeaderKnowsAtOnceThatItMayNotAct) {
  Server server;
  Elector a(&server, "a"), b(&server, "b");
  a.Run(0);
  for (int now = 0; now < 20; ++now) b.Run(now);
  EXPECT_EQ(b.Epoch(19), 2);
  EXPECT_EQ(a.Epoch(19), std::nullopt);  // before it has done anything
  a.Run(19);
  EXPECT_EQ(a.Epoch(19), std::nullopt);
  EXPECT_EQ(a.election().holder(), "b");
}

TEST(LeaderElection, LostAnswerOfARenewalIsFoundOutByReading) {
  Server server;
  Elector a(&server, "a");
  a.Run(0);
  const auto step = a.election().Next(At(2));
  server.lease->renewed = "done, but who knows";
  ++server.version;
  a.election().Failed(At(3));
  (void)step;
  a.Run(5);
  EXPECT_EQ(a.Epoch(14.9), 1);
  EXPECT_EQ(server.lease->transitions, 1);
}

TEST(LeaderElection, TwoThatRaceAreDecidedByTheServer) {
  Server server;
  Elector a(&server, "a"), b(&server, "b");
  const auto read = [&](Elector& e) {
    ASSERT_EQ(e.election().Next(At(0)).action, Action::kRead);
    e.election().Read(At(0), server.lease);
  };
  read(a);
  read(b);
  const auto of_a = a.election().Next(At(0)), of_b = b.election().Next(At(0));
  ASSERT_EQ(of_a.action, Action::kCreate);
  ASSERT_EQ(of_b.action, Action::kCreate);
  b.Write(of_b, 0, 0);
  a.Write(of_a, 0, 0);
  a.Run(0.5);
  EXPECT_EQ(b.Epoch(1), 1);
  EXPECT_EQ(a.Epoch(1), std::nullopt);
}

TEST(LeaderElection, ReleasedLeaseIsTakenAtTheNextLook) {
  Server server;
  Elector a(&server, "a"), b(&server, "b");
  a.Run(0);
  b.Run(0.5);
  a.election().Resign();
  EXPECT_EQ(a.Epoch(1), std::nullopt);  // before the server knows
  a.Run(1);
  EXPECT_EQ(server.lease->holder, "");
  EXPECT_EQ(server.lease->transitions, 1);
  a.Run(100);  // never again
  EXPECT_EQ(server.lease->holder, "");
  b.Run(2.5);
  EXPECT_EQ(b.Epoch(2.5), 2);
}

TEST(LeaderElection, WhoDoesNotHoldTheLeaseReleasesNothing) {
  Server server;
  Elector a(&server, "a"), b(&server, "b");
  a.Run(0);
  b.Run(0);
  const int version = server.version;
  b.election().Resign();
  b.Run(1);
  EXPECT_EQ(server.version, version);
}

TEST(LeaderElection, StolenOrDeletedLeaseEndsLeading) {
  Server server;
  Elector a(&server, "a");
  a.Run(0);
  server.lease->holder = "thief";
  ++server.version;
  a.Run(2);
  a.Run(2.3);
  EXPECT_EQ(a.Epoch(2.3), std::nullopt);

  Server other;
  Elector b(&other, "b");
  b.Run(0);
  other.lease.reset();
  ++other.version;
  b.Run(2);
  EXPECT_EQ(b.Epoch(2.1), 1);  // not known yet: the write was refused
  b.Run(2.3);
  EXPECT_EQ(b.Epoch(2.3), 2);  // made anew, and not with an epoch that was there before
  EXPECT_EQ(other.lease->transitions, 2);
}

// Many worlds of three candidates with pauses, lost requests and lost answers: never do two lead at once, every epoch
// has one leader, and epochs rise.
TEST(LeaderElection, NeverLeadTwoAtOnceHoweverTheyAreDisturbed) {
  int hand_overs = 0;
  for (uint64_t seed = 1; seed <= 200; ++seed) {
    std::mt19937_64 random(seed);
    const auto chance = [&](int in) { return random() % in == 0; };
    Server server;
    std::vector<Elector> all;
    for (const char* name : {"a", "b", "c"}) all.emplace_back(&server, name);
    std::vector<double> asleep(3, 0);
    std::vector<bool> offline(3, false);
    std::map<int64_t, size_t> leader_of;
    int64_t last = 0;
    for (double now = 0; now < 300; now += 0.25) {
      for (size_t i = 0; i < 3; ++i) {
        if (chance(200)) asleep[i] = now + static_cast<double>(random() % 30);
        if (chance(100)) offline[i] = !offline[i];
        if (now < asleep[i]) continue;
        const auto step = all[i].election().Next(At(now));
        if (step.action == Action::kReplace && chance(10)) {  // done, but the answer is lost
          Lease lease = step.lease;
          lease.renewed = std::to_string(++server.clock);
          server.lease = lease;
          ++server.version;
          all[i].election().Failed(At(now));
        } else {
          all[i].Run(now, !offline[i]);
        }
      }
      int leaders = 0;
      for (size_t i = 0; i < 3; ++i) {
        const auto epoch = all[i].Epoch(now);
        if (!epoch) continue;
        ++leaders;
        EXPECT_GE(*epoch, last) << "seed " << seed << " at " << now;
        hand_overs += *epoch > last ? 1 : 0;
        last = *epoch;
        EXPECT_EQ(leader_of.emplace(*epoch, i).first->second, i) << "seed " << seed << " at " << now;
      }
      ASSERT_LE(leaders, 1) << "seed " << seed << " at " << now;
    }
  }
  EXPECT_GT(hand_overs, 1000);
}

TEST(Lease, IsWrittenIntoAnObjectThatKeepsAllElse) {
  Json object = {{"metadata", {{"name", "l"}}}, {"spec", {{"strategy", "x"}}}};
  const Lease lease{"me", 3, seconds(15), "2006-01-02T15:04:05.000001Z", "2006-01-02T15:04:06.000000Z"};
  PutLease(lease, &object);
  EXPECT_EQ(LeaseOf(object), lease);
  EXPECT_EQ(object["spec"]["strategy"], "x");
  EXPECT_EQ(LeaseOf(Json::object()), Lease());
  EXPECT_EQ(LeaseOf({{"spec", {{"holderIdentity", nullptr}, {"leaseTransitions", "2"}}}}), Lease());
}

TEST(Lease, MicroTimeHasSixDigits) {
  EXPECT_EQ(MicroTime(absl::FromUnixSeconds(1136214245)), "2006-01-02T15:04:05.000000Z");
  EXPECT_EQ(MicroTime(absl::FromUnixMicros(1136214245000120)), "2006-01-02T15:04:05.000120Z");
}

}  // namespace
}  // namespace aureole::kubernetes
