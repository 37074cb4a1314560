#include "server/control/reconcile.h"

#include <gtest/gtest.h>

namespace aureole {
namespace {

RegionObserved Running() {
  RegionObserved r;
  r.incarnation = 3;
  r.alive = r.joined = r.connected = true;
  r.silent_s = 0.2;
  return r;
}

RegionObserved Dead(const char* how = "killed by signal 9") {
  RegionObserved r = Running();
  r.alive = r.connected = false;
  r.how = how;
  return r;
}

// What is done about a region that is seen so, while another one runs.
std::string Decide(const RegionObserved& r, bool recovers = true, bool over = false) {
  std::string out;
  for (const Action& a : Reconcile({recovers, over, {Running(), r}})) {
    constexpr const char* kNames[] = {"start", "end", "give up"};
    EXPECT_EQ(a.region, 1);
    out += std::string(kNames[static_cast<int>(a.kind)]) + " " + std::to_string(a.incarnation) + ": " + a.why;
  }
  return out;
}

TEST(Reconcile, RegionThatRunsIsLeftAlone) { EXPECT_EQ(Decide(Running()), ""); }

TEST(Reconcile, RegionWithoutAServerGetsItsFirst) { EXPECT_EQ(Decide({}, false), "start 1: the world begins"); }

TEST(Reconcile, DeadServerIsReplacedByTheNextIncarnation) {
  EXPECT_EQ(Decide(Dead()), "start 4: killed by signal 9");
  RegionObserved clean = Dead("exit status 0");
  clean.clean = true;
  EXPECT_EQ(Decide(clean), "start 4: exit status 0") << "it had not finished";
}

TEST(Reconcile, SilentServerIsEndedAndReplacedOnceItIsGone) {
  RegionObserved r = Running();
  r.silent_s = kLeaseSeconds + 0.5;
  EXPECT_EQ(Decide(r), "end 3: nothing heard of it for 6.5 s");
  r.alive = false;
  r.how = "killed by signal 9";
  EXPECT_EQ(Decide(r), "start 4: killed by signal 9");
}

TEST(Reconcile, ServerThatLeftHasAMomentToEndByItself) {
  RegionObserved r = Running();
  r.connected = false;
  r.silent_s = 1;
  EXPECT_EQ(Decide(r), "");
  r.silent_s = kExitAfterLeaveSeconds + 1;
  EXPECT_EQ(Decide(r), "end 3: its stream ended");
}

TEST(Reconcile, ServerOfAnEarlierControlPlaneHasAMomentToJoinAgain) {
  RegionObserved r = Running();
  r.joined = r.connected = false;
  r.adopted = true;
  r.silent_s = kRejoinSeconds - 1;
  EXPECT_EQ(Decide(r), "");
  r.silent_s = kRejoinSeconds + 1;
  EXPECT_EQ(Decide(r), "end 3: it has not joined again");
}

TEST(Reconcile, ServerThatLoadsHasNothingToSay) {
  RegionObserved r = Running();
  r.joined = r.connected = false;
  r.silent_s = 100;
  EXPECT_EQ(Decide(r), "");
}

TEST(Reconcile, ServerThatGetsNoFurtherIsStartedEverMoreSeldomAndThenGivenUp) {
  double before = -1;
  for (int failures = 0; failures < kMostFailures; ++failures) {
    EXPECT_GT(BackOffSeconds(failures), before);
    before = BackOffSeconds(failures);
    RegionObserved r = Dead();
    r.failures = failures;
    r.down_s = before + 0.01;
    EXPECT_EQ(Decide(r), "start 4: killed by signal 9") << failures;
    if (failures == 0) continue;
    r.down_s = before - 0.01;
    EXPECT_EQ(Decide(r), "") << failures;
  }
  RegionObserved r = Dead();
  r.failures = kMostFailures;
  r.down_s = 100;
  EXPECT_EQ(Decide(r), "give up 3: killed by signal 9");
  EXPECT_LE(BackOffSeconds(1000), 10);
}

TEST(Reconcile, WithoutCheckpointsTheFirstLossEndsTheRun) {
  EXPECT_EQ(Decide(Dead(), false), "give up 3: killed by signal 9");
}

TEST(Reconcile, SilentServerThatCannotBeReplacedIsWaitedFor) {
  RegionObserved r = Running();
  r.silent_s = 100 * kLeaseSeconds;
  EXPECT_EQ(Decide(r, false), "");
}

TEST(Reconcile, ServerOfARegionThatShallNotJoinAfterAllIsEndedUnlessItHearsOfIt) {
  RegionObserved r = Running();
  r.wanted = r.member = false;
  EXPECT_EQ(Decide(r), "") << "it was told to end";
  r.joined = r.connected = false;
  EXPECT_EQ(Decide(r), "end 3: it is not needed any more");
  r.alive = false;
  EXPECT_EQ(Decide(r), "");
}

TEST(Reconcile, ServerThatIsToJoinIsTriedAgainHoweverOftenItFailed) {
  RegionObserved r = Dead();
  r.failures = kMostFailures;
  r.down_s = 100;
  r.member = false;
  EXPECT_EQ(Decide(r), "start 4: killed by signal 9");
}

TEST(Reconcile, RegionsThatHaveFinishedMayGo) {
  RegionObserved r = Dead("exit status 0");
  r.clean = r.finished = true;
  EXPECT_EQ(Decide(r), "");
  EXPECT_EQ(Decide(Dead(), true, true), "") << "the run is over";
}

}  // namespace
}  // namespace aureole
