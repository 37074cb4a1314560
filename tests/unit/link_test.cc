#include "server/core/link.h"

#include <gtest/gtest.h>

namespace aureole {
namespace {

TEST(Link, ResumesAfterTheLastAppliedMessage) {
  LinkSender<int> sender;
  for (int i = 1; i <= 5; ++i) EXPECT_EQ(sender.Push(i * 10), static_cast<uint64_t>(i));
  sender.Acknowledge(2);
  EXPECT_EQ(sender.kept(), 3u);
  std::vector<int> again;
  ASSERT_TRUE(sender.CanResume(3));
  sender.Resume(3, [&](uint64_t, int m) { again.push_back(m); });
  EXPECT_EQ(again, (std::vector<int>{40, 50}));
}

TEST(Link, CannotResumeBehindWhatWasAcknowledgedOrAheadOfWhatWasSent) {
  LinkSender<int> sender;
  sender.Push(1);
  sender.Push(2);
  sender.Acknowledge(2);
  EXPECT_FALSE(sender.CanResume(1));
  EXPECT_TRUE(sender.CanResume(2));
  EXPECT_FALSE(sender.CanResume(3));
}

TEST(Link, ReceiverAppliesEachMessageOnceAndSeesGaps) {
  LinkReceiver receiver;
  EXPECT_EQ(receiver.Check(1), LinkReceiver::Verdict::kApply);
  EXPECT_EQ(receiver.Check(1), LinkReceiver::Verdict::kDuplicate);
  EXPECT_EQ(receiver.Check(3), LinkReceiver::Verdict::kGap);
  EXPECT_EQ(receiver.Check(2), LinkReceiver::Verdict::kApply);
  EXPECT_EQ(receiver.applied(), 2u);
}

}  // namespace
}  // namespace aureole
