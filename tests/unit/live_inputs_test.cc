// Inputs of clients: told in order, delivered once, and their outcomes.
#include "server/core/live_inputs.h"

#include <gtest/gtest.h>

namespace aureole {
namespace {

Input Kick(uint64_t sequence) {
  Input i;
  i.kind = Input::Kind::kImpulse;
  i.source = 3;
  i.sequence = sequence;
  i.body = 1;
  return i;
}

// Tells, delivers, applies and settles what is offered, in one tick.
void RunTick(LiveInputs* live, Tick n, bool apply = true) {
  live->Deliver(live->TakeOffered(), n, n, true);
  std::vector<Input> due;
  live->due().AppendDue(n, &due);
  for (const Input& i : due) {
    if (apply) live->Applied(i, 1);
  }
  live->Heard(live->TakeApplied());
  live->Settle(n);
  live->ForgetBefore(n + 1);
}

TEST(LiveInputs, MoreThanATickCanTellWaitForTheNext) {
  LiveInputs live;
  const uint64_t most = LiveInputs::kMostPerTick;
  for (uint64_t n = 1; n <= most + 5; ++n) ASSERT_TRUE(live.Offer(Kick(n)).ok());
  const std::vector<Input> first = live.TakeOffered(), second = live.TakeOffered();
  EXPECT_EQ(first.size(), most);
  ASSERT_EQ(second.size(), 5u);
  EXPECT_EQ(second.front().sequence, most + 1);
  EXPECT_EQ(live.offered(), 0u);
}

TEST(LiveInputs, RepetitionWhileItIsOpenGetsItsOutcomeToo) {
  LiveInputs live;
  live.Deliver({Kick(1)}, 7, 7, false);  // another region told it
  live.Deliver({Kick(1)}, 8, 8, true);
  live.Heard({{{3, 1}, 1}});
  live.Settle(7);
  const std::vector<InputOutcome> outcomes = live.TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_EQ(outcomes[0].tick, 7);
  EXPECT_TRUE(outcomes[0].applied());
  EXPECT_EQ(live.TakeDelivered().size(), 1u);
}

TEST(LiveInputs, OutcomeThatIsNoLongerKeptIsForgottenAndActsNotAgain) {
  LiveInputs live({.outcomes = 10});
  for (uint64_t n = 1; n <= 11; ++n) {
    ASSERT_TRUE(live.Offer(Kick(n)).ok());
    RunTick(&live, static_cast<Tick>(n), n == 1);
  }
  live.TakeOutcomes();
  live.TakeDelivered();
  ASSERT_TRUE(live.Offer(Kick(1)).ok());
  ASSERT_TRUE(live.Offer(Kick(2)).ok());
  RunTick(&live, 2000);
  const std::vector<InputOutcome> outcomes = live.TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 2u);
  EXPECT_EQ(outcomes[0].tick, 0) << "forgotten";
  EXPECT_EQ(outcomes[1].tick, 2);
  EXPECT_FALSE(outcomes[1].applied());
  EXPECT_TRUE(live.TakeDelivered().empty());
}

Input SpawnOf(uint64_t client, uint64_t sequence, std::shared_ptr<const Shape> shape) {
  auto body = std::make_shared<BodySpec>();
  body->shape = std::move(shape);
  Input i;
  i.kind = Input::Kind::kSpawn;
  i.source = client;
  i.sequence = sequence;
  i.spawn = std::move(body);
  return i;
}

TEST(LiveInputs, LargeBodiesAreToldOverSeveralTicksAndCopiesCountTheirShapeOnce) {
  auto large = std::make_shared<Shape>();
  large->kind = ShapeKind::kCompound;
  for (int child = 0; child < 64; ++child) {
    auto hull = std::make_shared<Shape>();
    hull->kind = ShapeKind::kHull;
    hull->points.resize(64);
    large->children.push_back({Vec3::Zero(), Quat::Identity(), hull});
  }
  LiveInputs live;
  for (uint64_t n = 1; n <= 1000; ++n) ASSERT_TRUE(live.Offer(SpawnOf(3, n, large)).ok());
  EXPECT_EQ(live.TakeOffered().size(), 1000u);
  for (uint64_t n = 1001; n <= 1040; ++n) {
    ASSERT_TRUE(live.Offer(SpawnOf(3, n, std::make_shared<Shape>(*large))).ok());
  }
  EXPECT_LE(live.TakeOffered().size(), 10u);
  EXPECT_GE(live.TakeOffered().size(), 1u);
}

TEST(LiveInputs, InputsOverAreasFillATickSooner) {
  LiveInputs live;
  for (uint64_t n = 1; n <= 100; ++n) {
    Input i = Kick(n);
    i.body = 0;
    i.area.radius = 5;
    ASSERT_TRUE(live.Offer(i).ok());
  }
  EXPECT_EQ(live.TakeOffered().size(), 16u);
}

TEST(LiveInputs, NoMoreBodiesOfClientsThanTheWorldHolds) {
  LiveInputs live({.bodies = 2});
  const auto ball = std::make_shared<Shape>();
  for (uint64_t n = 1; n <= 3; ++n) ASSERT_TRUE(live.Offer(SpawnOf(3, n, ball)).ok());
  RunTick(&live, 1);
  std::vector<InputOutcome> outcomes = live.TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 3u);
  EXPECT_TRUE(outcomes[0].applied() && outcomes[1].applied());
  EXPECT_TRUE(outcomes[2].full && !outcomes[2].applied());
  Input remove = Kick(4);
  remove.kind = Input::Kind::kRemove;
  remove.body = outcomes[0].body;
  ASSERT_TRUE(live.Offer(remove).ok());
  RunTick(&live, 2);
  ASSERT_TRUE(live.Offer(SpawnOf(3, 5, ball)).ok());
  ASSERT_TRUE(live.Offer(SpawnOf(3, 6, ball)).ok());
  RunTick(&live, 3);
  outcomes = live.TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 3u);
  EXPECT_TRUE(outcomes[1].applied()) << "there is room for one again";
  EXPECT_TRUE(outcomes[2].full);
}

TEST(LiveInputs, OnlySoManyForcesActAtOnce) {
  LiveInputs live({.lasting = 130});
  const auto force = [](uint64_t sequence, double radius) {
    Input i = Kick(sequence);
    i.ticks = 10;
    if (radius > 0) i.body = 0;
    i.area.radius = radius;
    return i;
  };
  for (uint64_t n = 1; n <= 3; ++n) ASSERT_TRUE(live.Offer(force(n, 5)).ok());
  for (uint64_t n = 4; n <= 6; ++n) ASSERT_TRUE(live.Offer(force(n, 0)).ok());
  RunTick(&live, 1);
  std::vector<bool> full;
  for (const InputOutcome& o : live.TakeOutcomes()) full.push_back(o.full);
  EXPECT_EQ(full, (std::vector<bool>{false, false, true, false, false, true}));
  ASSERT_TRUE(live.Offer(Kick(7)).ok());
  ASSERT_TRUE(live.Offer(force(8, 0)).ok());
  RunTick(&live, 10);
  ASSERT_TRUE(live.Offer(force(9, 0)).ok());
  RunTick(&live, 11);  // those of tick 1 are over
  full.clear();
  for (const InputOutcome& o : live.TakeOutcomes()) full.push_back(o.full);
  EXPECT_EQ(full, (std::vector<bool>{false, true, false}));
}

TEST(LiveInputs, ClientThatWasSilentForLongestMakesRoomAndOneThatHasSpokenDoesNot) {
  LiveInputs live({.clients = 2});
  const auto kick = [](uint64_t client, uint64_t sequence) {
    Input i = Kick(sequence);
    i.source = client;
    return i;
  };
  const auto run = [&](const Input& input, Tick n) {
    EXPECT_TRUE(live.Offer(input).ok());
    RunTick(&live, n);
    const std::vector<InputOutcome> outcomes = live.TakeOutcomes();
    EXPECT_EQ(outcomes.size(), 1u);
    return outcomes.empty() ? InputOutcome{} : outcomes[0];
  };
  const Tick later = LiveInputs::kKeptTicks + 10;
  EXPECT_TRUE(run(kick(1, 5), 1).applied());
  EXPECT_TRUE(run(kick(2, 5), 2).applied());
  EXPECT_TRUE(run(kick(3, 5), 3).full);
  EXPECT_TRUE(run(kick(1, 6), later).applied());
  EXPECT_TRUE(run(kick(3, 5), later + 1).applied()) << "in place of client 2";
  EXPECT_FALSE(run(kick(1, 6), later + 2).full);
  EXPECT_TRUE(run(kick(2, 6), later + 3).full);
}

TEST(LiveInputs, OutcomesOfAClientThatIsSilentForLongAreDropped) {
  LiveInputs live;
  ASSERT_TRUE(live.Offer(Kick(1)).ok());
  RunTick(&live, 1);
  live.Settle(2 * LiveInputs::kKeptTicks);
  live.TakeOutcomes();
  ASSERT_TRUE(live.Offer(Kick(1)).ok());
  RunTick(&live, 2 * LiveInputs::kKeptTicks + 1);
  const std::vector<InputOutcome> outcomes = live.TakeOutcomes();
  ASSERT_EQ(outcomes.size(), 1u);
  EXPECT_EQ(outcomes[0].tick, 0);
}

}  // namespace
}  // namespace aureole
