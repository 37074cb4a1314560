// The layout of a running world changes at a tick, everywhere at once, and no bit of any body does.
#include <array>
#include <limits>
#include <memory>
#include <vector>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "server/core/division.h"
#include "tests/simulation/lockstep.h"

namespace aureole {
namespace {

using sim::Lockstep;
using sim::Undivided;
using testing::ElementsAre;
using testing::HasSubstr;
constexpr double kInf = std::numeric_limits<double>::infinity();

BodySpec Ball(BodyId id, double x, double z = 0, double vx = 0, bool asleep = false) {
  auto shape = std::make_shared<Shape>();
  shape->radius = 0.3;
  BodySpec b;
  b.id = id;
  b.shape = shape;
  b.position = {x, 0, z};
  b.velocity = {vx, 0, 0};
  b.asleep = asleep;
  return b;
}

World Columns(std::vector<double> edges) {
  World w(*Layout::Columns(edges));
  w.environment.gravity = Vec3::Zero();
  return w;
}

Rect Column(double from, double to) { return {from, to, -kInf, kInf}; }

// Ranks as the regions are numbered.
LayoutChange Change(uint64_t epoch, std::vector<Rect> regions, std::vector<RegionId> members) {
  LayoutChange c{epoch, std::move(regions), {}, std::move(members)};
  for (size_t i = 0; i < c.regions.size(); ++i) c.ranks.push_back(static_cast<int>(i));
  return c;
}

Input Ask(uint64_t sequence, const LayoutChange& change) {
  Input i;
  i.source = kControlSource;
  i.sequence = sequence;
  i.kind = Input::Kind::kLayout;
  i.layout = std::make_shared<const LayoutChange>(change);
  return i;
}

Input Kick(uint64_t sequence, BodyId body) {
  Input i;
  i.source = 9;
  i.sequence = sequence;
  i.kind = Input::Kind::kVelocityChange;
  i.body = body;
  i.linear = {0, 0, 2};
  return i;
}

std::string Refused(const LayoutChange& change) { return std::string(LayoutOf(change).status().message()); }

TEST(LayoutChange, MustBeATilingOfTheMembers) {
  const LayoutChange good = Change(2, {Column(-kInf, 0), {}, Column(0, kInf)}, {0, 2});
  ASSERT_TRUE(LayoutOf(good).ok());
  const auto refused = [&good](const char* why, auto spoil) {
    LayoutChange bad = good;
    spoil(&bad);
    EXPECT_THAT(Refused(bad), HasSubstr(why));
  };
  refused("regions: none covers", [](LayoutChange* c) { c->regions[0] = {}; });
  refused("regions: none covers", [](LayoutChange* c) { c->regions = {{}, {}, {}}; });
  refused("overlaps regions[0]", [](LayoutChange* c) { c->regions[2] = Column(-1, kInf); });
  refused("regions[1]: is empty", [](LayoutChange* c) { c->regions[1] = Column(3, 3); });
  refused("regions: must not be empty", [](LayoutChange* c) { c->regions = {}; });
  refused("regions: must be at most 64", [](LayoutChange* c) { c->regions.resize(65); });
  refused("ranks", [](LayoutChange* c) { c->ranks = {0, 1, 1}; });
  refused("ranks", [](LayoutChange* c) { c->ranks = {0, 1}; });
  refused("members[1]", [](LayoutChange* c) { c->members = {0, 3}; });
  refused("members[1]", [](LayoutChange* c) { c->members = {0, 0, 2}; });
  refused("members: must name region 2", [](LayoutChange* c) { c->members = {0}; });
}

TEST(LayoutChange, RegionWithoutAreaIsNobodysHome) {
  const Layout l = *LayoutOf(Change(2, {{}, Column(-kInf, 3), {}, Column(3, kInf)}, {0, 1, 3}));
  for (double x : {-1e9, 0.0, 2.9, 3.0, 1e9}) EXPECT_EQ(l.Home(x, 0), x < 3 ? 1 : 3);
  EXPECT_EQ(l.Home(kInf, 0), 1) << "what is nowhere has some home too";
  EXPECT_EQ(l.ChainNumber(1), 2);
  EXPECT_EQ(l.NarrowestExtent(), kInf);
  const Box at_origin{Vec3(-1, -1, -1), Vec3(1, 1, 1)};
  EXPECT_EQ(l.rect(0).Gap(at_origin), kInf);
  EXPECT_FALSE(l.rect(0).Encloses({Vec3::Zero(), Vec3::Zero()}, 0));
}

TEST(LayoutChange, HasNoEffectUnlessItFollowsTheOneInForce) {
  Division d(*Layout::Columns(std::array{0.0, 10.0}));
  const std::vector<Rect> now{Column(-kInf, 0), Column(0, 10), Column(10, kInf)};
  const auto refusal = [&d](const LayoutChange& c) { return std::string(d.Deliver(c, 20).message()); };
  EXPECT_THAT(refusal(Change(1, now, {0, 1, 2})), HasSubstr("epoch: is 1, but that of the layout in force is 1"));
  EXPECT_THAT(refusal(Change(3, now, {0, 1, 2})), HasSubstr("epoch: is 3"));
  EXPECT_THAT(refusal(Change(2, {Column(-kInf, 0), Column(0, kInf)}, {0, 1})), HasSubstr("regions: are 2"));
  const std::vector<Rect> without{Column(-kInf, 10), {}, Column(10, kInf)};
  EXPECT_THAT(refusal(Change(2, without, {0, 2})), HasSubstr("members: must name region 1, which holds bodies"));
  ASSERT_EQ(refusal(Change(2, without, {0, 1, 2})), "");
  EXPECT_THAT(refusal(Change(2, now, {0, 1, 2})), HasSubstr("another change takes effect at the start of tick 20"));

  EXPECT_EQ(d.At(19, 12)->epoch, 1u);
  EXPECT_EQ(d.At(20, 12)->epoch, 2u);
  EXPECT_EQ(d.At(27, 12)->epoch, 2u);
  EXPECT_EQ(d.At(28, 12), nullptr) << "another may be in force by then";
  d.Adopt(20);
  EXPECT_EQ(d.now().epoch, 2u);
  d.Emptied(1);
  EXPECT_EQ(refusal(Change(3, without, {0, 2})), "");
}

TEST(LayoutChange, IsRefusedWhereTheExchangeHasADelay) {
  World w = Columns({0});
  w.exchange.k = 1;
  Lockstep s(w);
  const LayoutChange change = Change(2, {Column(-kInf, 1), Column(1, kInf)}, {0, 1});
  EXPECT_THAT(std::string(s.region(0).Submit(Ask(1, change)).message()), HasSubstr("has a delay of 1 ticks"));
  const auto joined = Region::Join(w, 1, MakeToyEngine(w.environment), change);
  EXPECT_THAT(std::string(joined.status().message()), HasSubstr("has a delay of 1 ticks"));
}

TEST(LayoutChange, IsOfTheControlPlaneOnly) {
  Lockstep s(Columns({0}));
  Input i = Ask(1, Change(2, {Column(-kInf, 1), Column(1, kInf)}, {0, 1}));
  i.source = 5;
  EXPECT_THAT(std::string(s.region(0).Submit(i).message()), HasSubstr("input.source"));
  i = Kick(1, 1);
  i.source = kControlSource;
  EXPECT_THAT(std::string(s.region(0).Submit(i).message()), HasSubstr("input.source"));
}

TEST(LayoutChange, IsAdoptedByAllAtTheSameTickAndTheBodiesFollow) {
  World w = Columns({0});
  w.bodies = {Ball(1, -3), Ball(2, 3, 0, 0, true), Ball(3, 3.59), Ball(4, 8), Ball(5, -1, 4, 1)};
  Lockstep s(w);
  Undivided whole(w);
  s.RunTo(2);
  ASSERT_TRUE(s.region(1).Submit(Ask(1, Change(2, {Column(-kInf, 5), Column(5, kInf)}, {0, 1}))).ok());
  s.RunTo(3);
  for (RegionId r : {0, 1}) EXPECT_EQ(s.region(r).next_layout_at(), 3 + kLayoutNotice);
  s.RunTo(2 + kLayoutNotice);
  for (RegionId r : {0, 1}) EXPECT_EQ(s.region(r).layout_epoch(), 1u);
  EXPECT_TRUE(s.region(1).TakeOutcomes().empty());
  s.RunTo(3 + kLayoutNotice);
  for (RegionId r : {0, 1}) {
    EXPECT_EQ(s.region(r).layout_epoch(), 2u);
    EXPECT_EQ(s.region(r).layout().rect(0), Column(-kInf, 5));
  }
  const std::vector<InputOutcome> outcomes = s.region(1).TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_EQ(outcomes[0].tick, 3 + kLayoutNotice);
  EXPECT_EQ(outcomes[0].refused, "");
  s.RunTo(30);
  whole.RunTo(30);
  for (BodyId id : {1, 2, 3, 5}) EXPECT_EQ(s.Owner(id), 0) << id;
  EXPECT_EQ(s.Owner(4), 1);
  EXPECT_EQ(s.Hash(), whole.Hash());
  for (RegionId r : {0, 1}) EXPECT_EQ(s.region(r).stats().home_crossings, 0) << "no body has crossed anything";
}

TEST(LayoutChange, OfTwoAtATimeTheSecondHasNoEffectAndSaysSo) {
  Lockstep s(Columns({0}));
  ASSERT_TRUE(s.region(0).Submit(Ask(1, Change(2, {Column(-kInf, 5), Column(5, kInf)}, {0, 1}))).ok());
  ASSERT_TRUE(s.region(1).Submit(Ask(2, Change(2, {Column(-kInf, 7), Column(7, kInf)}, {0, 1}))).ok());
  s.RunTo(20);
  for (RegionId r : {0, 1}) EXPECT_EQ(s.region(r).layout().rect(0), Column(-kInf, 5));
  const std::vector<InputOutcome> outcomes = s.region(1).TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_THAT(outcomes[0].refused, HasSubstr("another change takes effect at the start of tick 9"));
  // What is asked again acts once, and has the same outcome.
  ASSERT_TRUE(s.region(0).Submit(Ask(2, Change(3, {Column(-kInf, 7), Column(7, kInf)}, {0, 1}))).ok());
  s.RunTo(40);
  EXPECT_EQ(s.region(0).layout_epoch(), 2u);
  EXPECT_EQ(s.region(0).TakeOutcomes().back(), outcomes[0]);
}

// Cuts the right half of two in two.
const LayoutChange kThird = Change(2, {Column(-kInf, 0), Column(0, 10), Column(10, kInf)}, {0, 1, 2});

TEST(LayoutChange, RegionJoinsEmptyAndGetsItsBodiesInAnOrdinaryWay) {
  World w = Columns({0});
  w.bodies = {Ball(1, -3), Ball(2, 12, 0, 0, true), Ball(3, 12.59), Ball(4, 5, 0, 3)};
  Lockstep s(w);
  Undivided whole(w);
  s.RunTo(5);
  s.Join(2, kThird);
  EXPECT_EQ(s.region(2).phase(), Phase::kJoin);
  EXPECT_FALSE(s.region(2).Ready());
  ASSERT_TRUE(s.region(0).Submit(Ask(1, kThird)).ok());
  s.RunTo(120);
  whole.RunTo(120);
  EXPECT_EQ(s.region(2).tick(), 120);
  EXPECT_THAT(s.region(0).members(), ElementsAre(0, 1, 2));
  EXPECT_THAT(s.region(0).peers(), ElementsAre(1, 2));
  for (BodyId id : {2, 3, 4}) EXPECT_EQ(s.Owner(id), 2) << id;
  EXPECT_EQ(s.Hash(), whole.Hash());
}

TEST(LayoutChange, RegionThatJoinsKnowsWhatClientsHaveSaid) {
  World w = Columns({0});
  w.bodies = {Ball(1, -3), Ball(2, 12)};
  Lockstep s(w);
  ASSERT_TRUE(s.region(0).Submit(Kick(1, 2)).ok());
  s.Join(2, kThird);
  ASSERT_TRUE(s.region(0).Submit(Ask(1, kThird)).ok());
  s.RunTo(30);
  const double speed = s.region(2).engine().View(2).velocity.z();
  EXPECT_GT(speed, 1.9);
  ASSERT_TRUE(s.region(2).Submit(Kick(1, 2)).ok()) << "what was said elsewhere, long ago";
  s.RunTo(33);
  EXPECT_LT(s.region(2).engine().View(2).velocity.z(), 2.1);
  const std::vector<InputOutcome> outcomes = s.region(2).TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_EQ(outcomes[0].bodies, 1);
  EXPECT_EQ(outcomes[0].tick, 2);
}

// All its bodies: those that lie, sleep, touch each other, or have just come.
TEST(LayoutChange, RegionWithoutAreaEmptiesAndThenLeaves) {
  World w = Columns({0, 10});
  w.bodies = {Ball(1, -3), Ball(2, 5, 0, 0, true), Ball(3, 5.55), Ball(4, 6.1), Ball(5, 12), Ball(6, 9.9, 3, -2)};
  Lockstep s(w);
  Undivided whole(w);
  const LayoutChange empty = Change(2, {Column(-kInf, 5.5), {}, Column(5.5, kInf)}, {0, 1, 2});
  const LayoutChange drop = Change(3, empty.regions, {0, 2});
  ASSERT_TRUE(s.region(1).Submit(Ask(1, empty)).ok());
  s.RunTo(kLayoutNotice + 1);
  EXPECT_EQ(s.region(1).layout_epoch(), 2u);
  EXPECT_EQ(s.region(1).bodies(), 0) << "few enough for one tick";
  ASSERT_TRUE(s.region(0).Submit(Ask(2, drop)).ok());
  s.RunTo(60);
  whole.RunTo(60);
  EXPECT_EQ(s.region(1).phase(), Phase::kLeft);
  EXPECT_FALSE(s.region(1).Ready());
  EXPECT_THAT(s.region(0).members(), ElementsAre(0, 2));
  s.Drop(1);
  s.RunTo(80);
  whole.RunTo(80);
  EXPECT_EQ(s.Hash(), whole.Hash());
}

TEST(LayoutChange, RegionThatHoldsBodiesCannotLeave) {
  World w = Columns({0, 10});
  for (BodyId id = 1; id <= 2000; ++id) {
    w.bodies.push_back(Ball(id, 0.5 + static_cast<double>(id % 10), static_cast<double>(id), 0, true));
  }
  Lockstep s(w);
  const LayoutChange empty = Change(2, {Column(-kInf, 0), {}, Column(0, kInf)}, {0, 1, 2});
  ASSERT_TRUE(s.region(1).Submit(Ask(1, empty)).ok());
  s.RunTo(kLayoutNotice);
  ASSERT_EQ(s.region(1).bodies(), 2000);
  ASSERT_TRUE(s.region(2).Submit(Ask(2, Change(3, empty.regions, {0, 2}))).ok());
  s.RunTo(kLayoutNotice + 2);
  s.region(2).TakeOutcomes();
  EXPECT_EQ(s.region(1).bodies(), 2000 - 2 * 512) << "no tick moves them all";
  ASSERT_TRUE(s.region(2).Submit(Ask(3, Change(3, empty.regions, {0, 2}))).ok());
  s.RunTo(kLayoutNotice + 5);
  const std::vector<InputOutcome> outcomes = s.region(2).TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_THAT(outcomes[0].refused, HasSubstr("must name region 1, which holds bodies"));
  EXPECT_EQ(s.region(1).bodies(), 0);
  ASSERT_TRUE(s.region(2).Submit(Ask(4, Change(3, empty.regions, {0, 2}))).ok());
  s.RunTo(40);
  EXPECT_EQ(s.region(1).phase(), Phase::kLeft);
  EXPECT_EQ(s.region(2).bodies(), 2000);
}

TEST(LayoutChange, NameOfARegionThatHasLeftIsFreeAgain) {
  World w = Columns({0});
  w.bodies = {Ball(1, -3), Ball(2, 12), Ball(3, 11.5)};
  Lockstep s(w);
  Undivided whole(w);
  const LayoutChange one = Change(2, {Column(-kInf, kInf), {}}, {0, 1});
  ASSERT_TRUE(s.region(0).Submit(Ask(1, one)).ok());
  s.RunTo(12);
  ASSERT_TRUE(s.region(0).Submit(Ask(2, Change(3, one.regions, {0}))).ok());
  s.RunTo(30);
  s.Drop(1);
  EXPECT_TRUE(s.region(0).peers().empty());
  EXPECT_EQ(s.region(0).FramesTaken(1), 0u);
  s.RunTo(40);
  const LayoutChange two = Change(4, {Column(-kInf, 4), Column(4, kInf)}, {0, 1});
  s.Join(1, two);
  ASSERT_TRUE(s.region(0).Submit(Ask(3, two)).ok());
  s.RunTo(90);
  whole.RunTo(90);
  EXPECT_EQ(s.Owner(2), 1);
  EXPECT_EQ(s.region(0).FramesTaken(1), s.region(1).FramesTaken(0) - 2)
      << "both anew; a welcome and two bodies went one way";
  EXPECT_EQ(s.Hash(), whole.Hash());
}

TEST(LayoutChange, CheckpointHoldsTheLayoutAndTheChangeToCome) {
  World w = Columns({0});
  w.bodies = {Ball(1, -3), Ball(2, 5)};
  Lockstep s(w);
  ASSERT_TRUE(s.region(0).Submit(Ask(1, kThird)).ok());
  s.Join(2, kThird);
  const auto again = [&](RegionId r) { return *Region::Load(w, r, MakeToyEngine(w.environment), s.region(r).Save()); };
  s.RunTo(4);
  EXPECT_EQ(again(1)->next_layout_at(), 1 + kLayoutNotice);
  EXPECT_EQ(again(1)->next_layout(), *LayoutOf(kThird));
  s.RunTo(20);
  for (RegionId r : {0, 1, 2}) {
    EXPECT_EQ(again(r)->layout_epoch(), 2u);
    EXPECT_EQ(again(r)->layout(), *LayoutOf(kThird));
    EXPECT_EQ(again(r)->members(), s.region(r).members());
    EXPECT_EQ(again(r)->peers(), s.region(r).peers());
  }
}

TEST(LayoutChange, WelcomeToAnotherLayoutIsRefused) {
  World w = Columns({0});
  LayoutChange other = kThird;
  other.epoch = 3;
  const auto region = *Region::Join(w, 2, MakeToyEngine(w.environment), kThird);
  Frame f;
  f.from = 0;
  f.to = {2};
  f.tick = 8;
  f.round = kWelcome;
  EXPECT_THAT(std::string(region->Receive(f).message()), HasSubstr("frame.welcome"));
  f.welcome = "damaged";
  EXPECT_THAT(std::string(region->Receive(f).message()), HasSubstr("another program"));
  f.welcome.clear();
  Writer writer(&f.welcome);
  writer(Division(other));
  LiveInputs().Teach(writer);
  EXPECT_THAT(std::string(region->Receive(f).message()), HasSubstr("to the layout of epoch 3"));
  EXPECT_FALSE(region->Ready());
  f.welcome.clear();
  writer(Division(kThird));
  LiveInputs().Teach(writer);
  EXPECT_TRUE(region->Receive(f).ok());
  EXPECT_TRUE(region->Ready());
}

}  // namespace
}  // namespace aureole
