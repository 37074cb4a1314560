// Worlds that scale themselves by their load, on real servers: they grow and shrink, come to rest, and every body is
// where the undivided world has it.
#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <filesystem>
#include <iterator>
#include <memory>
#include <utility>
#include <vector>

#include <absl/strings/match.h>

#include "server/control/layout_desk.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/sqlite_store.h"
#include "server/transport/world_spec.h"
#include "tests/e2e/exact_run.h"
#include "tests/e2e/killer.h"

namespace aureole {
namespace {

namespace fs = std::filesystem;
using std::chrono::milliseconds;

constexpr int kHeap = 60;  // bodies of one place; each falls, and sleeps a second or so later

// Two columns. After a second a good deal of bodies falls, in both of them and on the border, and then sleeps.
v1::WorldSpec Rain() {
  v1::WorldSpec spec;
  spec.set_name("rain");
  spec.mutable_layout()->mutable_columns()->add_edges(0);
  spec.add_statics()->mutable_shape()->mutable_plane()->mutable_normal()->set_y(1);
  for (double x : {-14.0, -7.0, 0.0, 7.0, 14.0}) {
    v1::Injector* injector = spec.add_injectors();
    injector->set_rate(kHeap);
    injector->mutable_start()->set_seconds(1);
    injector->mutable_duration()->set_seconds(1);
    v1::Injector::Volume* volume = injector->add_volumes();
    volume->mutable_min()->set_x(x - 2);
    volume->mutable_max()->set_x(x + 2);
    volume->mutable_min()->set_z(-10);
    volume->mutable_max()->set_z(10);
    volume->mutable_min()->set_y(20);
    volume->mutable_max()->set_y(24);
    v1::Injector::Kind* kind = injector->add_kinds();
    kind->mutable_shape()->mutable_box()->mutable_size()->set_x(0.5);
    kind->mutable_shape()->mutable_box()->mutable_size()->set_y(0.5);
    kind->mutable_shape()->mutable_box()->mutable_size()->set_z(0.5);
  }
  return spec;
}

class AutoscalingTest : public testing::Test {
 protected:
  AutoscalingTest() {
    std::string name = (fs::temp_directory_path() / "autoscaling-test-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
    options_.world = Rain();
    absl::StatusOr<World> world = WorldFromSpec(options_.world);
    EXPECT_TRUE(world.ok()) << world.status();
    world_ = std::make_unique<World>(*std::move(world));
    NextControlPlane();
    options_.regions = 2;
    options_.hash_every = 5;
    // Bodies decide: how long a frame takes on this machine nobody knows.
    options_.scaling = {2, 5, 1000, 40, milliseconds(500), milliseconds(1000)};
  }
  ~AutoscalingTest() override { fs::remove_all(directory_); }

  void NextControlPlane() {
    desk_ = std::make_unique<LayoutDesk>(*world_);
    options_.layouts = desk_.get();
  }

  // Until `look` says so; then OK.
  absl::Status Run(const RunObserver& look, LocalAllocator::Options servers = {}) {
    servers.log_directory = directory_ / "logs";
    servers.data_directory = directory_ / "data";
    LocalAllocator allocator(servers);
    const auto end = Killer::Clock::now() + std::chrono::seconds(90);
    bool late = false;
    const absl::Status s = RunWorld(
        options_, allocator,
        [&](const RunStatus& status) {
          late = Killer::Clock::now() > end;
          return !late && look(status);
        },
        &result_,
        [this](const RunEvent& e) {
          events_ += "region " + std::to_string(e.region) + ": " + e.what + "\n";
          if (absl::StartsWith(e.what, "scaled from ")) scaled_.push_back(e.what);
        });
    if (late) return absl::DeadlineExceededError(events_);
    return absl::IsCancelled(s) ? absl::OkStatus() : s;
  }

  // With as few as there may be, all asleep, some time after there were more.
  bool Rests(const RunStatus& status) const {
    return most_ > 2 && Members() == 2 && !desk_->state().changing && status.Bodies() == 5 * kHeap;
  }
  size_t Members() const { return desk_->state().now.members.size(); }

  // Of every tick that all have reported, from this one on.
  void ExpectExact(Tick from = 0) {
    SCOPED_TRACE(events_);
    TickSum last;
    ExpectExactSoFar(result_, options_, from, &last);
    EXPECT_EQ(last.bodies, 5 * kHeap);
    for (const RegionStatus& r : result_.status.regions) EXPECT_EQ(r.report.refused_frames(), 0);
  }

  fs::path directory_;
  std::unique_ptr<World> world_;
  std::unique_ptr<LayoutDesk> desk_;
  RunOptions options_;
  RunResult result_;
  std::string events_;
  std::vector<std::string> scaled_;
  std::vector<size_t> sizes_;  // numbers of members, one after the other
  size_t most_ = 0;            // regions at once
};

TEST_F(AutoscalingTest, AWorldGrowsWithItsLoadAndShrinksAgainAndNoBitChanges) {
  Tick rests = 0;
  const absl::Status s = Run([&](const RunStatus& status) {
    most_ = std::max(most_, Members());
    if (sizes_.empty() || sizes_.back() != Members()) sizes_.push_back(Members());
    if (!Rests(status)) rests = status.MinTick();
    return status.MinTick() < rests + 100;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_GT(most_, 2u);
  ASSERT_GE(scaled_.size(), 2u) << events_;
  EXPECT_TRUE(absl::StartsWith(scaled_[0], "scaled from 2 to ")) << scaled_[0];
  EXPECT_TRUE(absl::StrContains(scaled_[0], "bodies awake of 40 in the busiest region for 0.5 s")) << scaled_[0];
  // Up, and then down.
  EXPECT_TRUE(std::is_sorted(sizes_.begin(), std::max_element(sizes_.begin(), sizes_.end()))) << events_;
  EXPECT_TRUE(
      std::is_sorted(sizes_.rbegin(), std::make_reverse_iterator(std::max_element(sizes_.begin(), sizes_.end()))))
      << events_;
  EXPECT_LE(sizes_.size(), 7u) << events_;
  ExpectExact();
}

TEST_F(AutoscalingTest, TheNextControlPlaneGoesOnFromWhatIsInForceWhileServersAreKilled) {
  options_.checkpoint_every = 40;
  Killer killer(7, 4, milliseconds(1500));
  // One leaves with more regions, one while they become fewer, one stays to the end.
  for (int plane = 0; plane < 3; ++plane) {
    absl::StatusOr<std::unique_ptr<SqliteStore>> store = SqliteStore::Open(directory_ / "control.db");
    ASSERT_TRUE(store.ok()) << store.status();
    options_.store = store->get();
    options_.control_epoch = (*store)->epoch();
    std::atomic<bool> leave = false;
    options_.leave = &leave;
    NextControlPlane();
    LocalAllocator::Options servers;
    servers.outlive = true;
    Tick rests = 0;
    const absl::Status s = Run(
        [&](const RunStatus& status) {
          if (status.stage != Stage::kRunning) return true;
          most_ = std::max(most_, Members());
          if (plane > 0) killer.Look(status);
          const LayoutDesk::State state = desk_->state();
          if (plane == 0) leave = most_ > 2 && !state.changing;
          if (plane == 1) leave = !state.leaving.empty();
          if (!Rests(status)) rests = status.MinTick();
          return plane < 2 || status.MinTick() < rests + 100;
        },
        servers);
    ASSERT_TRUE(s.ok()) << s;
  }
  EXPECT_EQ(Members(), 2u) << events_;
  ASSERT_FALSE(result_.hashes.empty());
  ExpectExact(result_.status.MinTick() - 20);
}

TEST_F(AutoscalingTest, FrameTimeAloneIsEnough) {
  options_.scaling = {1, 3, 1, 0, milliseconds(200), milliseconds(100000)};  // 1 % of the tick: 0.16 ms
  const absl::Status s = Run([&](const RunStatus& status) {
    return status.stage != Stage::kRunning || Members() < 3 || desk_->state().changing || status.MinTick() < 150;
  });
  ASSERT_TRUE(s.ok()) << s;
  ASSERT_EQ(scaled_.size(), 1u) << events_;
  EXPECT_TRUE(absl::StartsWith(scaled_[0], "scaled from 2 to 3 regions: p99 of the busiest region ")) << scaled_[0];
}

TEST_F(AutoscalingTest, WhatOperatorsWantLastsWithinTheBounds) {
  options_.scaling = {1, 3, 1000, 100000, milliseconds(200), milliseconds(1000)};
  bool asked = false;
  const absl::Status s = Run([&](const RunStatus& status) {
    most_ = std::max(most_, Members());
    if (status.stage == Stage::kRunning && !std::exchange(asked, true)) {
      EXPECT_TRUE(desk_->Resize(6, 1).ok());
    }
    return Members() != 1 || desk_->state().changing;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_EQ(most_, 6u);
  ASSERT_EQ(scaled_.size(), 2u) << events_;
  EXPECT_EQ(scaled_[0], "scaled from 6 to 3 regions: there must be 1 to 3");
  EXPECT_TRUE(absl::StartsWith(scaled_[1], "scaled from 3 to 1 regions: ")) << scaled_[1];
}

}  // namespace
}  // namespace aureole
