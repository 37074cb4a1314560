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
  LiveInputs live;
  ASSERT_TRUE(live.Offer(Kick(1)).ok());
  RunTick(&live, 1);
  live.TakeOutcomes();
  for (uint64_t n = 2; n <= LiveInputs::kKeptOutcomes + 1; ++n) {
    ASSERT_TRUE(live.Offer(Kick(n)).ok());
    RunTick(&live, static_cast<Tick>(n), false);
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
