#include "server/control/checkpoint_desk.h"

#include <gtest/gtest.h>

#include <map>
#include <optional>

namespace aureole {
namespace {

constexpr int64_t kTickUs = 10'000;

// Regions of a run, the last of which is no member, and what they are told.
class CheckpointDeskTest : public testing::Test {
 protected:
  CheckpointDeskTest() {
    status_.stage = Stage::kRunning;
    status_.regions.resize(3);
    status_.regions[2].member = false;
    for (RegionStatus& r : status_.regions) r.report.set_tick(100);
    status_.regions[1].report.set_tick(120);
  }
  ~CheckpointDeskTest() override { desk_.Close(); }

  void Ask(CheckpointDesk* desk, bool copied = false) {
    desk->Ask(copied, [this](const absl::Status& s, const v1::SaveCheckpointResponse& r) {
      EXPECT_EQ(said_, std::nullopt) << "once";
      said_ = s;
      saved_ = r;
    });
  }
  void Step() {
    desk_.Step(status_, [this](RegionId r, Tick tick) { told_[r] = tick; });
  }
  void Report(RegionId r, Tick durable, Tick copied = 0) {
    status_.regions[static_cast<size_t>(r)].report.set_checkpoint_tick(durable);
    status_.regions[static_cast<size_t>(r)].report.set_copied_tick(copied);
    Step();
  }

  CheckpointDesk desk_{1000, kTickUs};
  RunStatus status_;
  std::map<RegionId, Tick> told_;
  std::optional<absl::Status> said_;
  v1::SaveCheckpointResponse saved_;
};

TEST_F(CheckpointDeskTest, AnswersWhenAllMembersHaveOneOfTheTickOrLater) {
  Report(0, 90);
  Ask(&desk_);
  Step();
  const Tick tick = told_[0];
  EXPECT_GT(tick, 120 + 40) << "half a second from now";
  EXPECT_EQ(told_, (std::map<RegionId, Tick>{{0, tick}, {1, tick}})) << "of one tick, and members only";
  Report(0, tick);
  Report(1, tick - 1);
  EXPECT_EQ(said_, std::nullopt);
  Report(1, tick + 3);
  ASSERT_TRUE(said_.has_value());
  EXPECT_TRUE(said_->ok()) << *said_;
  EXPECT_EQ(saved_.tick(), tick);
  ASSERT_EQ(saved_.regions_size(), 2);
  EXPECT_EQ(saved_.regions(1).tick(), tick + 3);
}

TEST_F(CheckpointDeskTest, WaitsForTheCopiesWhenAskedTo) {
  Ask(&desk_, true);
  Step();
  Report(0, 1000, 1000);
  Report(1, 1000, 100);
  EXPECT_EQ(said_, std::nullopt);
  Report(1, 1000, 999);
  ASSERT_TRUE(said_.has_value());
  EXPECT_TRUE(said_->ok()) << *said_;
}

TEST_F(CheckpointDeskTest, RegionThatCannotWriteIsNamed) {
  Ask(&desk_);
  status_.regions[1].report.set_storage_failure("the disk is full");
  Step();
  ASSERT_TRUE(said_.has_value());
  EXPECT_EQ(said_->code(), absl::StatusCode::kUnavailable);
  EXPECT_NE(said_->message().find("region 1 cannot write: the disk is full"), std::string::npos) << *said_;
}

TEST_F(CheckpointDeskTest, WhatCannotBeIsRefused) {
  CheckpointDesk none(0, kTickUs);
  Ask(&none);
  ASSERT_TRUE(said_.has_value());
  EXPECT_EQ(said_->code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_NE(said_->message().find("--checkpoint-every"), std::string::npos);
  said_.reset();
  status_.regions[1].member = false;
  Ask(&desk_, true);
  Step();
  ASSERT_TRUE(said_.has_value());
  EXPECT_EQ(said_->code(), absl::StatusCode::kFailedPrecondition) << "one region has no neighbour";
  EXPECT_EQ(said_->message().substr(0, 8), "copied: ");
}

TEST_F(CheckpointDeskTest, BoundsHowManyWaitAndTellsThemOfTheEnd) {
  size_t over = 0;
  for (size_t i = 0; i < CheckpointDesk::kMostWaiting; ++i) {
    desk_.Ask(false, [&](const absl::Status& s, const v1::SaveCheckpointResponse&) {
      EXPECT_EQ(s.code(), absl::StatusCode::kUnavailable);
      ++over;
    });
  }
  Ask(&desk_);
  ASSERT_TRUE(said_.has_value());
  EXPECT_EQ(said_->code(), absl::StatusCode::kResourceExhausted);
  desk_.Close();
  EXPECT_EQ(over, CheckpointDesk::kMostWaiting);
  said_.reset();
  Ask(&desk_);
  ASSERT_TRUE(said_.has_value());
  EXPECT_EQ(said_->code(), absl::StatusCode::kUnavailable);
}

}  // namespace
}  // namespace aureole
