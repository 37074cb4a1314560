// Control planes that come and go over servers that run on: the world is, bit for bit, that of one control plane.
#include <gtest/gtest.h>
#include <signal.h>

#include <atomic>
#include <cstdlib>
#include <filesystem>
#include <fstream>

#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/sqlite_store.h"
#include "tests/e2e/exact_run.h"
#include "tests/e2e/killer.h"

namespace aureole {
namespace {

namespace fs = std::filesystem;

class ControlRestart : public testing::Test {
 protected:
  ControlRestart() {
    std::string name = (fs::temp_directory_path() / "restart-test-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
  }
  ~ControlRestart() override { fs::remove_all(directory_); }

  static RunOptions OptionsFor(const std::string& world, Tick last_tick) {
    return aureole::OptionsFor(world, last_tick, 10, 40);
  }

  // One control plane, until the run ends or `observe` says that it leaves.
  absl::Status Run(RunOptions options, const std::function<bool(const RunStatus&)>& leaves, uint64_t epoch = 0) {
    absl::StatusOr<std::unique_ptr<SqliteStore>> store = SqliteStore::Open(directory_ / "control.db");
    EXPECT_TRUE(store.ok()) << store.status();
    if (!store.ok()) return store.status();
    LocalAllocator::Options servers;
    servers.log_directory = directory_ / "logs";
    servers.data_directory = directory_ / "data";
    servers.outlive = true;
    LocalAllocator allocator(servers);
    std::atomic<bool> leave = false;
    options.leave = &leave;
    options.store = store->get();
    options.control_epoch = epoch == 0 ? (*store)->epoch() : epoch;
    events_.clear();
    return RunWorld(
        options, allocator,
        [&](const RunStatus& status) {
          leave = leaves(status);
          return true;
        },
        &result_,
        [this](const RunEvent& e) { events_ += "region " + std::to_string(e.region) + ": " + e.what + "\n"; });
  }

  void ExpectExact(const RunOptions& options) const { aureole::ExpectExact(result_, options); }
  std::string LogOf(int region) const {
    std::ifstream in(directory_ / "logs" / ("region-" + std::to_string(region) + ".log"));
    return {std::istreambuf_iterator<char>(in), {}};
  }

  fs::path directory_;
  RunResult result_;
  std::string events_;
};

TEST_F(ControlRestart, NextControlPlaneGoesOnWithTheServersThatRun) {
  const RunOptions options = OptionsFor("demo.json", 300);
  absl::Status s = Run(options, [](const RunStatus& status) { return status.MinTick() > 40; });
  EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s;
  const std::vector<RegionStatus> before = result_.status.regions;
  ASSERT_EQ(before.size(), 4u);
  for (const RegionStatus& r : before) EXPECT_EQ(kill(static_cast<pid_t>(r.pid), 0), 0) << "its servers go on";
  s = Run(options, [](const RunStatus&) { return false; });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_EQ(events_, "") << "no server was replaced";
  for (size_t i = 0; i < before.size(); ++i) {
    EXPECT_EQ(result_.status.regions[i].pid, before[i].pid);
    EXPECT_EQ(result_.status.regions[i].incarnation, 1u);
  }
  ExpectExact(options);
}

TEST_F(ControlRestart, LeavesAtAnyMomentOfTheStart) {
  const RunOptions options = OptionsFor("demo.json", 120);
  // What has been seen when it leaves: nothing, one server, all of them, a world that is loaded, or one that runs.
  for (const int seen : {0, 1, 4, 5, 6}) {
    const absl::Status s = Run(options, [seen](const RunStatus& status) {
      int now = 0;
      for (const RegionStatus& r : status.regions) now += r.joined ? 1 : 0;
      if (status.stage >= Stage::kReady) now = 5;
      if (status.stage == Stage::kRunning) now = 6;
      return now >= seen;
    });
    EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s;
  }
  const absl::Status s = Run(options, [](const RunStatus&) { return false; });
  ASSERT_TRUE(s.ok()) << s;
  ExpectExact(options);
}

TEST_F(ControlRestart, ServersThatDiedMeanwhileAreReplaced) {
  const RunOptions options = OptionsFor("corner-storm.json", 400);
  for (const Tick tick : {60, 160}) {
    const absl::Status s = Run(options, [tick](const RunStatus& status) { return status.MinTick() > tick; });
    EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s;
    const int victims = tick == 60 ? 1 : 3;
    for (int i = 0; i < victims; ++i) {
      EXPECT_EQ(kill(static_cast<pid_t>(result_.status.regions[static_cast<size_t>(i)].pid), SIGKILL), 0);
    }
  }
  const absl::Status s = Run(options, [](const RunStatus&) { return false; });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_EQ(result_.status.regions[0].incarnation, 3u);
  EXPECT_EQ(result_.status.regions[2].incarnation, 2u);
  EXPECT_EQ(result_.status.regions[3].incarnation, 1u);
  ExpectExact(options);
}

TEST_F(ControlRestart, RunThatEndsMeanwhileIsHeardOf) {
  const RunOptions options = OptionsFor("demo.json", 60);
  absl::Status s = Run(options, [](const RunStatus& status) { return status.MinTick() > 5; });
  EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s;
  const auto finished = [this] {
    for (int i = 0; i < 4; ++i) {
      if (LogOf(i).find("finished at tick 60") == std::string::npos) return false;
    }
    return true;
  };
  while (!finished()) std::this_thread::sleep_for(std::chrono::milliseconds(20));
  s = Run(options, [](const RunStatus&) { return false; });
  ASSERT_TRUE(s.ok()) << s;
  ExpectExact(options);
}

TEST_F(ControlRestart, FrozenControlPlaneThatWakesIsNotObeyed) {
  const RunOptions options = OptionsFor("demo.json", 300);
  absl::Status s = Run(
      options, [](const RunStatus& status) { return status.MinTick() > 20; }, 7);
  EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s;
  s = Run(
      options, [this](const RunStatus&) { return LogOf(2).find("not obeyed") != std::string::npos; }, 6);
  EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s;
  EXPECT_NE(LogOf(2).find("a control plane of epoch 6 speaks after one of epoch 7: not obeyed"), std::string::npos);
  s = Run(
      options, [](const RunStatus&) { return false; }, 8);
  ASSERT_TRUE(s.ok()) << s;
  ExpectExact(options);
}

TEST_F(ControlRestart, StoreOfAnotherWorldIsNotTouched) {
  RunOptions options = OptionsFor("demo.json", 300);
  absl::Status s = Run(options, [](const RunStatus& status) { return status.MinTick() > 20; });
  EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s;
  RunOptions other = options;
  other.world.set_seed(other.world.seed() + 1);
  s = Run(other, [](const RunStatus&) { return false; });
  EXPECT_EQ(s.code(), absl::StatusCode::kFailedPrecondition) << s;
  EXPECT_NE(s.message().find("the store has another world"), std::string::npos) << s;
  s = Run(options, [](const RunStatus&) { return false; });
  ASSERT_TRUE(s.ok()) << s;
  ExpectExact(options);
}

}  // namespace
}  // namespace aureole
