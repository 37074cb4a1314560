// Region servers that die, freeze or cannot start: the run goes on, bit for bit, or says why it cannot.
#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>

#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/world_file.h"
#include "tests/e2e/killer.h"

namespace aureole {
namespace {

namespace fs = std::filesystem;
using std::chrono::milliseconds;

class Recovery : public testing::Test {
 protected:
  Recovery() {
    std::string name = (fs::temp_directory_path() / "recovery-test-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
  }
  ~Recovery() override { fs::remove_all(directory_); }

  static RunOptions OptionsFor(const std::string& world, Tick last_tick) {
    const absl::StatusOr<WorldFile> file = OpenWorldFile(std::string(AUREOLE_WORLDS "/") + world);
    EXPECT_TRUE(file.ok()) << file.status();
    RunOptions options;
    options.world = file->spec;
    options.regions = file->world.layout.size();
    options.last_tick = last_tick;
    options.hash_every = 25;
    options.checkpoint_every = 40;
    return options;
  }

  absl::Status Run(const RunOptions& options, const RunObserver& observe) {
    LocalAllocator allocator({"", directory_ / "logs", false, directory_ / "data"});
    const absl::Status s = RunWorld(options, allocator, observe, &result_, [this](const RunEvent& e) {
      events_ += "region " + std::to_string(e.region) + ": " + e.what + "\n";
    });
    EXPECT_EQ(allocator.running(), 0);
    return s;
  }

  // Every hash is there, and is that of the undivided world.
  void ExpectExact(RunOptions options) {
    options.undivided = options.no_real_time = true;
    options.regions = 1;
    options.checkpoint_every = 0;
    LocalAllocator allocator({});
    RunResult whole;
    ASSERT_TRUE(RunWorld(
                    options, allocator, [](const RunStatus&) { return true; }, &whole)
                    .ok());
    ASSERT_EQ(result_.hashes.size(), whole.hashes.size());
    for (size_t i = 0; i < whole.hashes.size(); ++i) {
      EXPECT_EQ(result_.hashes[i].tick, whole.hashes[i].tick);
      EXPECT_EQ(result_.hashes[i].regions, static_cast<int>(result_.status.regions.size()));
      EXPECT_EQ(result_.hashes[i].hash, whole.hashes[i].hash) << "tick " << whole.hashes[i].tick;
      EXPECT_EQ(result_.hashes[i].bodies, whole.hashes[i].bodies) << "tick " << whole.hashes[i].tick;
    }
  }

  fs::path directory_;
  RunResult result_;
  std::string events_;
};

TEST_F(Recovery, ServersKilledAtRandomMomentsChangeNoBit) {
  const RunOptions options = OptionsFor("corner-storm.json", 500);
  Killer killer(7, 12, milliseconds(400));
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    killer.Look(status);
    return true;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_GE(killer.killed(), 6);
  EXPECT_LT(killer.longest_stop().count(), 10);
  ExpectExact(options);
}

TEST_F(Recovery, AllServersKilledAtOnceGoOn) {
  const RunOptions options = OptionsFor("demo.json", 250);
  bool killed = false;
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    if (killed || status.stage != Stage::kRunning || status.MinTick() < 100) return true;
    for (const RegionStatus& r : status.regions) EXPECT_EQ(kill(static_cast<pid_t>(r.pid), SIGKILL), 0);
    killed = true;
    return true;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_TRUE(killed);
  ExpectExact(options);
}

TEST_F(Recovery, FrozenServerIsReplacedAfterItsLease) {
  const RunOptions options = OptionsFor("demo.json", 160);
  pid_t frozen = 0;
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    if (frozen == 0 && status.stage == Stage::kRunning && status.MinTick() > 60) {
      frozen = static_cast<pid_t>(status.regions[1].pid);
      EXPECT_EQ(kill(frozen, SIGSTOP), 0);
    }
    return true;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_NE(events_.find("region 1: incarnation 1 is ended: nothing heard of it for"), std::string::npos) << events_;
  EXPECT_NE(events_.find("region 1: incarnation 2 is started"), std::string::npos) << events_;
  ExpectExact(options);
}

TEST_F(Recovery, DamagedCheckpointEndsTheRunAndIsNamed) {
  const RunOptions options = OptionsFor("demo.json", 0);
  bool killed = false;
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    if (killed || status.stage != Stage::kRunning || status.MinTick() < 100) return true;
    killed = true;
    EXPECT_EQ(kill(static_cast<pid_t>(status.regions[3].pid), SIGSTOP), 0);
    std::fstream file(directory_ / "data/region-3/checkpoint", std::ios::in | std::ios::out | std::ios::binary);
    file.seekp(100);
    file.put('\x55');
    file.close();
    EXPECT_EQ(kill(static_cast<pid_t>(status.regions[3].pid), SIGKILL), 0);
    return true;
  });
  EXPECT_EQ(s.code(), absl::StatusCode::kAborted) << s;
  EXPECT_NE(s.message().find("data/region-3/checkpoint: the checkpoint's check sum is wrong"), std::string::npos) << s;
}

TEST_F(Recovery, WithoutCheckpointsADeadServerEndsTheRun) {
  RunOptions options = OptionsFor("demo.json", 0);
  options.checkpoint_every = 0;
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    if (status.MinTick() > 30) kill(static_cast<pid_t>(status.regions[2].pid), SIGKILL);
    return true;
  });
  EXPECT_EQ(s.code(), absl::StatusCode::kAborted) << s;
  EXPECT_NE(s.message().find("region 2 ended: killed by signal 9"), std::string::npos) << s;
}

}  // namespace
}  // namespace aureole
