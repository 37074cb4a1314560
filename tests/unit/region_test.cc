#include "server/core/region.h"

#include <array>
#include <cmath>
#include <map>
#include <vector>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/simulation/lockstep.h"

namespace aureole {
namespace {

using sim::Lockstep;
using sim::Undivided;
using testing::HasSubstr;

BodySpec Ball(BodyId id, double x, double vx = 0, bool asleep = false) {
  auto shape = std::make_shared<Shape>();
  shape->radius = 0.3;
  BodySpec b;
  b.id = id;
  b.shape = shape;
  b.position = {x, 0, 0};
  b.velocity = {vx, 0, 0};
  b.asleep = asleep;
  return b;
}

World TwoColumns() {
  World w(*Layout::Columns(std::array{0.0}));
  w.environment.gravity = Vec3::Zero();
  return w;
}

int64_t AurasSent(Lockstep& s) { return s.region(0).stats().auras_sent + s.region(1).stats().auras_sent; }

TEST(Region, CheckpointOfAnotherRegionOrDamagedIsRefused) {
  World w = TwoColumns();
  w.bodies = {Ball(1, -0.5, 1), Ball(2, 0.2, -1), Ball(3, 4)};
  Lockstep s(w);
  s.RunTo(30);
  const std::string saved = s.region(0).Save();
  const auto load = [&w](RegionId self, const std::string& bytes) {
    return Region::Load(w, self, MakeToyEngine(w.environment), bytes).status();
  };
  EXPECT_TRUE(load(0, saved).ok());
  EXPECT_THAT(std::string(load(1, saved).message()), HasSubstr("is of region 0 of 2, not of region 1 of 2"));
  EXPECT_THAT(std::string(load(0, saved + "x").message()), HasSubstr("damaged"));
  for (size_t n = 8; n < saved.size(); ++n) {
    EXPECT_THAT(std::string(load(0, saved.substr(0, n)).message()), HasSubstr("damaged")) << n;
  }
}

TEST(Region, BodyFarFromTheBorderCostsNoAuraTestAndNoByte) {
  World w = TwoColumns();
  for (BodyId id = 1; id <= 50; ++id) w.bodies.push_back(Ball(id, -100.0 - static_cast<double>(id), 0.5));
  Lockstep s(w);
  s.RunTo(100);
  EXPECT_EQ(s.region(0).stats().aura_tests, 0);
  EXPECT_EQ(AurasSent(s), 0);
  for (const Frame& f : s.LastFrames()) {
    EXPECT_TRUE(f.auras.empty() && f.gone.empty() && f.graphs.empty() && f.transfers.empty());
  }
}

World FourColumns() {
  World w(*Layout::Columns(std::array{-10.0, 0.0, 10.0}));
  w.environment.gravity = Vec3::Zero();
  return w;
}

int BoxFrames(const Lockstep& s) {
  int n = 0;
  for (const Frame& f : s.LastFrames()) n += f.round == kBoxes;
  return n;
}

TEST(Region, BoxesGoOnlyBetweenRegionsThatBodiesAreNear) {
  World w = FourColumns();
  w.bodies = {Ball(1, -0.7, 0)};
  Lockstep s(w);
  s.RunTo(1);
  EXPECT_EQ(BoxFrames(s), 0);
  s.RunTo(2);
  EXPECT_EQ(BoxFrames(s), 2) << "regions 1 and 2, each to the other";
  EXPECT_EQ(AurasSent(s), 0) << "near, but it does not touch";
  EXPECT_EQ(s.region(0).stats().graphs_again, 0);
}

TEST(Region, RegionsCloseToEachOtherWhenNothingHasBeenNearForAWhile) {
  World w = FourColumns();
  w.bodies = {Ball(1, -0.7, -8)};
  Lockstep s(w);
  s.RunTo(60);
  EXPECT_EQ(BoxFrames(s), 2);
  s.RunTo(80);
  EXPECT_EQ(BoxFrames(s), 2) << "it has come near region 0 meanwhile, and has long left region 2";
  s.RunTo(200);
  EXPECT_EQ(BoxFrames(s), 0);
}

TEST(Region, BodyThatComesTooFastIsToldLateAndTheGraphsAreMadeAgain) {
  World w = FourColumns();
  // In one tick from the middle of a column over its border, where another lies in wait: exact only if it is told.
  w.bodies = {Ball(1, -5, 331.25), Ball(2, 0.85, 0)};
  Lockstep s(w);
  Undivided whole(w);
  s.RunTo(1);
  for (RegionId r = 0; r < 4; ++r) EXPECT_EQ(s.region(r).stats().graphs_again, 0);
  s.RunTo(2);
  for (RegionId r = 0; r < 4; ++r) EXPECT_EQ(s.region(r).stats().graphs_again, 1) << "all do the same";
  s.RunTo(20);
  whole.RunTo(20);
  EXPECT_EQ(s.Hash(), whole.Hash());
}

TEST(Region, SleepingBodyOnTheBorderIsToldOnce) {
  World w = TwoColumns();
  w.bodies = {Ball(1, -0.1, 0, true)};
  Lockstep s(w);
  s.RunTo(1);
  EXPECT_EQ(AurasSent(s), 1);
  s.RunTo(200);
  EXPECT_EQ(AurasSent(s), 1);
  EXPECT_EQ(s.region(0).stats().auras_told, 1) << "and the peer still holds it";
}

TEST(Region, JointedBodiesNeverHaveTwoOwners) {
  World w = TwoColumns();
  w.bodies = {Ball(1, -3, 5), Ball(2, -2, 5)};
  JointSpec j;
  j.id = 1;
  j.a = 1;
  j.b = 2;
  w.joints = {j};
  Lockstep s(w);
  for (Tick n = 1; n <= 100; ++n) {
    s.RunTo(n);
    ASSERT_EQ(s.Owner(1), s.Owner(2)) << "tick " << n;
  }
  EXPECT_EQ(s.Owner(1), 1) << "they must have crossed";
}

TEST(Region, BodyThatWentHomeDoesNotComeBackAtOnce) {
  // It swings over the border; the dwell keeps it from changing owner with every swing.
  World w = TwoColumns();
  w.bodies = {Ball(1, -2, 8)};
  Lockstep s(w);
  s.RunTo(60);
  EXPECT_EQ(s.Owner(1), 1);
  EXPECT_EQ(s.BodiesMoved(), 1);
}

// Bodies 1 and 2 meet on the border and are one component from then on.
World Meeting(double mass_of_1) {
  World w = TwoColumns();
  w.bodies = {Ball(1, -0.25), Ball(2, 1.05, -10)};
  w.bodies[0].mass = mass_of_1;
  return w;
}

TEST(Region, TieGoesToTheBetterRank) {
  for (RegionId better : {0, 1}) {
    World w = Meeting(1);
    ASSERT_TRUE(w.layout.SetRanks(better == 0 ? std::vector<int>{0, 1} : std::vector<int>{1, 0}).ok());
    Lockstep s(w);
    for (Tick n = 1; n < 20 && s.BodiesMoved() == 0; ++n) s.RunTo(n);
    EXPECT_EQ(s.BodiesMoved(), 1);
    EXPECT_EQ(s.Owner(1), better);
    EXPECT_EQ(s.Owner(2), better);
  }
}

TEST(Region, WhatHasHardlyLeftStaysWithItsOwner) {
  World w = TwoColumns();
  w.exchange.dwell = 0;
  w.exchange.home_slack = 0.5;
  w.bodies = {Ball(1, -1, 1)};
  Lockstep s(w);
  Tick n = 0;
  while (n < 200 && s.Owner(1) == 0) s.RunTo(++n);
  ASSERT_EQ(s.Owner(1), 1);
  const BodyView v = s.region(1).engine().View(1);
  EXPECT_NEAR(v.box.min.x(), 0.5, 0.05) << "it is all outside, by the slack";
}

TEST(Region, IslandStaysForItsDwell) {
  World w = Meeting(100);
  w.exchange.dwell = 40;
  Lockstep s(w);
  Tick n = 0, came = 0;
  while (n < 20 && s.Owner(2) != 0) s.RunTo(++n);
  came = n;
  ASSERT_EQ(s.Owner(2), 0) << "body 1 is the heavier one";
  while (n < 100 && s.Owner(2) == 0) s.RunTo(++n);
  EXPECT_EQ(n - came, 40) << "it bounces back at once, and is alone in its home all the time";
}

std::map<BodyId, Epoch> Epochs(Lockstep& s) {
  std::map<BodyId, Epoch> epochs;
  for (RegionId r : {0, 1}) {
    std::vector<BodyRecord> records;
    s.region(r).Observe(&records);
    for (const BodyRecord& b : records) epochs[b.id] = b.epoch;
  }
  return epochs;
}

TEST(Region, EpochCountsTheChangesOfOwner) {
  World w = Meeting(100);
  Lockstep s(w);
  EXPECT_EQ(Epochs(s), (std::map<BodyId, Epoch>{{1, 0}, {2, 0}}));
  s.RunTo(40);
  EXPECT_EQ(s.Owner(2), 1) << "it went and came back";
  EXPECT_EQ(Epochs(s), (std::map<BodyId, Epoch>{{1, 0}, {2, 2}}));
}

TEST(Region, InputsOfOneTickApplyInTheirOrder) {
  World w = TwoColumns();
  w.bodies = {Ball(1, -5)};
  Lockstep s(w);
  s.RunTo(10);
  for (uint64_t source : {2, 1}) {  // the second one comes first
    Input in;
    in.kind = source == 1 ? Input::Kind::kVelocity : Input::Kind::kImpulse;
    in.source = source;
    in.sequence = 1;
    in.body = 1;
    in.linear = {source == 1 ? 5.0 : 2.0, 0, 0};
    ASSERT_TRUE(s.region(0).Submit(in).ok());
  }
  s.RunTo(12);
  EXPECT_DOUBLE_EQ(s.region(0).engine().View(1).velocity.x(), 7.0) << "set to 5, then 2 more";
}

TEST(Region, FrameOfAStrangerIsRefusedWithAReasonAndChangesNothing) {
  Lockstep s(TwoColumns());
  s.RunTo(3);
  const uint64_t hash = s.Hash();
  Frame f;
  f.from = 7;
  f.to = {0};
  EXPECT_THAT(std::string(s.region(0).Receive(f).message()), HasSubstr("frame.from: 7 is no peer"));
  f.from = 1;
  f.to = {1};
  EXPECT_THAT(std::string(s.region(0).Receive(f).message()), HasSubstr("frame.to"));
  f.to = {0};
  f.tick = 1 << 15;
  EXPECT_THAT(std::string(s.region(0).Receive(f).message()), HasSubstr("too far ahead"));
  f.tick = 3;
  EXPECT_THAT(std::string(s.region(0).Receive(f).message()), HasSubstr("cannot follow"));
  f.tick = 4;
  f.round = kGraphsOn;
  EXPECT_THAT(std::string(s.region(0).Receive(f).message()), HasSubstr("is not for region 1 to send"));
  f.round = kGraphs;
  f.gone = {5};
  EXPECT_THAT(std::string(s.region(0).Receive(f).message()), HasSubstr("frame.auras: not in this round"));
  f.gone.clear();
  f.graphs.emplace_back().of = 2;
  EXPECT_THAT(std::string(s.region(0).Receive(f).message()), HasSubstr("frame.graphs.of"));
  f.graphs.front().of = 1;
  f.graphs.front().opened = {1};
  EXPECT_THAT(std::string(s.region(0).Receive(f).message()), HasSubstr("frame.graphs.opened"));
  f.graphs.clear();
  f.round = kBoxes;
  Aura a;
  a.id = 5;
  a.box.min[0] = 2;
  f.auras = {a};
  EXPECT_THAT(std::string(s.region(0).Receive(f).message()), HasSubstr("frame.auras.box"));
  s.RunTo(4);
  EXPECT_EQ(s.Hash(), hash);
}

Input Kick(uint64_t sequence, BodyId body, double speed = 3) {
  Input i;
  i.kind = Input::Kind::kVelocity;
  i.source = 9;
  i.sequence = sequence;
  i.body = body;
  i.linear = {speed, 0, 0};
  return i;
}

TEST(Region, InputOfAClientActsWhereverItWasOfferedTwoTicksLater) {
  World w = TwoColumns();
  w.bodies = {Ball(1, -5)};
  Lockstep s(w);
  s.RunTo(10);
  ASSERT_TRUE(s.region(1).Submit(Kick(1, 1)).ok()) << "the body is in region 0";
  s.RunTo(11);
  EXPECT_DOUBLE_EQ(s.region(0).engine().View(1).velocity.x(), 0) << "it is told in this tick";
  s.RunTo(12);
  EXPECT_DOUBLE_EQ(s.region(0).engine().View(1).velocity.x(), 3);
  const std::vector<InputOutcome> outcomes = s.region(1).TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_EQ(outcomes[0].tick, 12);
  EXPECT_TRUE(outcomes[0].applied());
  for (RegionId r : {0, 1}) {
    const std::vector<Input> delivered = s.region(r).TakeDelivered();
    ASSERT_EQ(delivered.size(), 1u);
    EXPECT_EQ(delivered[0].tick, 12);
  }
  EXPECT_TRUE(s.region(0).TakeOutcomes().empty()) << "it was not offered there";
}

TEST(Region, WhatAClientRepeatsActsOnceAndHasTheSameOutcome) {
  World w = TwoColumns();
  w.bodies = {Ball(1, -5)};
  Lockstep s(w);
  Input hit = Kick(1, 1);
  hit.kind = Input::Kind::kImpulse;
  hit.linear *= 2;
  ASSERT_TRUE(s.region(0).Submit(hit).ok());
  ASSERT_TRUE(s.region(1).Submit(hit).ok());
  s.RunTo(5);
  const double speed = s.region(0).engine().View(1).velocity.x();
  ASSERT_GT(speed, 0);
  ASSERT_TRUE(s.region(1).Submit(hit).ok()) << "long after";
  s.RunTo(10);
  EXPECT_DOUBLE_EQ(s.region(0).engine().View(1).velocity.x(), speed);
  EXPECT_EQ(s.region(0).TakeOutcomes().size(), 1u);
  const std::vector<InputOutcome> outcomes = s.region(1).TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 2u);
  for (const InputOutcome& o : outcomes) {
    EXPECT_EQ(o.tick, 2);
    EXPECT_TRUE(o.applied());
  }
}

TEST(Region, InputForABodyThatIsNowhereIsNotApplied) {
  Lockstep s(TwoColumns());
  ASSERT_TRUE(s.region(0).Submit(Kick(1, 77)).ok());
  s.RunTo(5);
  const std::vector<InputOutcome> outcomes = s.region(0).TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_FALSE(outcomes[0].applied());
}

TEST(Region, ExplosionOverABorderActsOnTheBodiesOfBothSidesOnce) {
  World w = TwoColumns();
  w.bodies = {Ball(1, -2), Ball(2, 2), Ball(3, 9), Ball(4, 0.3)};
  Lockstep s(w);
  Input blast = Kick(1, 0);
  blast.kind = Input::Kind::kImpulse;
  blast.linear.setZero();
  blast.area = {{0.3, w.bodies[0].position.y(), 0}, 4, 6, true};
  ASSERT_TRUE(s.region(1).Submit(blast).ok());
  Undivided one(s.world());
  s.RunTo(2);
  for (Input i : s.region(0).TakeDelivered()) one.Add(i);
  one.RunTo(2);
  EXPECT_EQ(s.Hash(), one.Hash());
  EXPECT_LT(s.region(0).engine().View(1).velocity.x(), -1) << "away from the centre";
  EXPECT_GT(s.region(1).engine().View(2).velocity.x(), 1);
  EXPECT_EQ(s.region(1).engine().View(3).velocity.x(), 0) << "out of reach";
  EXPECT_EQ(s.region(1).engine().View(4).velocity.x(), 0) << "in the very centre";
  const std::vector<InputOutcome> outcomes = s.region(1).TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_EQ(outcomes[0].bodies, 3);
}

TEST(Region, ForceActsInEachOfItsTicksAlsoAcrossTheBorder) {
  World w = TwoColumns();
  w.bodies = {Ball(1, -0.5)};
  Lockstep s(w);
  Input force = Kick(1, 1, 0.25);
  force.kind = Input::Kind::kImpulse;
  force.ticks = 60;
  ASSERT_TRUE(s.region(1).Submit(force).ok());
  Undivided one(s.world());
  s.RunTo(1);
  for (Input i : s.region(0).TakeDelivered()) one.Add(i);
  for (Tick n = 2; n <= 70; ++n) {
    s.RunTo(n);
    one.RunTo(n);
    ASSERT_EQ(s.Hash(), one.Hash()) << n;
  }
  EXPECT_EQ(s.Owner(1), 1) << "it was pushed over";
  EXPECT_DOUBLE_EQ(s.region(1).engine().View(1).velocity.x(), 60 * 0.25 / w.bodies[0].mass);
  const std::vector<InputOutcome> outcomes = s.region(1).TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_EQ(outcomes[0].bodies, 1);
}

Input SpawnAt(uint64_t sequence, double x) {
  Input i = Kick(sequence, 0);
  i.kind = Input::Kind::kSpawn;
  i.spawn = std::make_shared<const BodySpec>(Ball(0, x));
  return i;
}

TEST(Region, BodiesThatClientsSpawnGetIdsInTheOrderInWhichTheyAreTold) {
  Lockstep s(TwoColumns());
  ASSERT_TRUE(s.region(1).Submit(SpawnAt(1, -3)).ok());
  Input other = SpawnAt(1, 3);
  other.source = 2;
  ASSERT_TRUE(s.region(0).Submit(other).ok());
  s.RunTo(2);
  EXPECT_EQ(s.Owner(kFirstLiveId), 1) << "region 0 speaks first";
  EXPECT_EQ(s.Owner(kFirstLiveId + 1), 0);
  const std::vector<InputOutcome> outcomes = s.region(1).TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_EQ(outcomes[0].body, kFirstLiveId + 1);
  EXPECT_EQ(outcomes[0].bodies, 1);
  ASSERT_TRUE(s.region(0).Submit(SpawnAt(1, -3)).ok());
  s.RunTo(5);
  EXPECT_EQ(s.Owner(kFirstLiveId + 2), kNoRegion) << "a repetition spawns nothing";
  EXPECT_EQ(s.region(0).TakeOutcomes().back().body, kFirstLiveId + 1);
}

TEST(Region, InputThatCannotBeIsRefusedWithTheField) {
  Lockstep s(TwoColumns());
  const auto refused = [&](const char* field, auto change) {
    Input i = Kick(1, 1);
    change(&i);
    EXPECT_THAT(std::string(s.region(0).Submit(i).message()), HasSubstr(field));
  };
  refused("input.source", [](Input* i) { i->source = 0; });
  refused("input.sequence", [](Input* i) { i->sequence = 0; });
  refused("input.body", [](Input* i) { i->body = 0; });
  refused("input.kind", [](Input* i) { i->kind = static_cast<Input::Kind>(9); });
  refused("input.spawn", [](Input* i) { i->kind = Input::Kind::kSpawn; });
  refused("input.body", [](Input* i) { i->area.radius = 1; });
  refused("input.area: only", [](Input* i) {
    i->area.radius = 1;
    i->body = 0;
  });
  refused("input.area.radius", [](Input* i) { i->area.radius = -1; });
  refused("input.area", [](Input* i) { i->area.outward = std::nan(""); });
  refused("input.point", [](Input* i) { i->point.x() = std::nan(""); });
  refused("input.frame", [](Input* i) { i->frame = static_cast<Input::Frame>(3); });
  refused("input.ticks", [](Input* i) { i->ticks = 2; });
  refused("input.linear", [](Input* i) { i->linear.x() = std::nan(""); });
  refused("input.angular", [](Input* i) { i->angular.y() = -HUGE_VAL; });
}

}  // namespace
}  // namespace aureole
