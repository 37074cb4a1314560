// Region servers that die, freeze or cannot start: the run goes on, bit for bit, or says why it cannot.
#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <thread>

#include "aureole/client.h"
#include "client/src/push_sender.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "tests/e2e/destroyer.h"
#include "tests/e2e/exact_run.h"
#include "tests/e2e/killer.h"
#include "tests/e2e/running_world.h"

namespace aureole {
namespace {

namespace fs = std::filesystem;
using std::chrono::milliseconds;

// Cannot reach a server that it has to end, as with a machine that is cut off: the next one starts while it lives.
class CutOffAllocator final : public Allocator {
 public:
  explicit CutOffAllocator(LocalAllocator::Options options) : servers_(std::move(options)) {}
  absl::Status Start(const ServerStart& start) override { return servers_.Start(start); }
  std::vector<ServerExit> Poll() override {
    std::vector<ServerExit> out = servers_.Poll();
    out.insert(out.end(), lost_.begin(), lost_.end());
    lost_.clear();
    return out;
  }
  int running() const override { return servers_.running(); }
  void End(RegionId region, uint64_t incarnation) override {
    lost_.push_back({region, incarnation, false, "its machine is lost", "", ""});
  }
  void Kill() override { servers_.Kill(); }

 private:
  LocalAllocator servers_;
  std::vector<ServerExit> lost_;
};

class Recovery : public testing::Test {
 protected:
  Recovery() {
    std::string name = (fs::temp_directory_path() / "recovery-test-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
  }
  ~Recovery() override { fs::remove_all(directory_); }

  static RunOptions OptionsFor(const std::string& world, Tick last_tick) {
    return aureole::OptionsFor(world, last_tick, 25, 40);
  }

  absl::Status Run(const RunOptions& options, const RunObserver& observe) {
    LocalAllocator allocator({"", directory_ / "logs", false, directory_ / "data"});
    const absl::Status s = RunWorld(options, allocator, observe, &result_, [this](const RunEvent& e) {
      events_ += NameOf(e.kind) + ", region " + std::to_string(e.region) + ": " + e.what + "\n";
    });
    EXPECT_EQ(allocator.running(), 0);
    return s;
  }

  // A client pushes while `trouble` looks on, until it has pushed enough; every push has acted once.
  void ExpectPushesActOnce(int pushes, const RunObserver& trouble);

  static void Damage(const fs::path& file) {
    std::fstream out(file, std::ios::in | std::ios::out | std::ios::binary);
    EXPECT_TRUE(out.is_open()) << file;
    out.seekp(100);
    out.put('\x55');
  }
  static bool AllHaveCopies(const RunStatus& status) {
    return status.stage == Stage::kRunning &&
           std::all_of(status.regions.begin(), status.regions.end(), Destroyer::HasCopy);
  }
  bool Happened(const std::string& event) const { return events_.find(event) != std::string::npos; }

  void ExpectExact(const RunOptions& options) const { aureole::ExpectExact(result_, options); }

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

void Recovery::ExpectPushesActOnce(int pushes, const RunObserver& trouble) {
  constexpr int kBodies = 16;
  constexpr double kPush = 1.0 / 1024;  // m/s: sums are exact
  RunOptions options;
  options.world = Lanes(kBodies);
  options.regions = 3;
  options.checkpoint_every = 40;
  std::vector<double> expected(kBodies, 0);
  std::map<uint64_t, double> found;
  client::PushCounts counts;
  std::atomic<bool> pushed = false, seen = false;
  std::atomic<int64_t> newest = 0;  // tick that was reported
  std::thread player;
  const auto play = [&](const std::vector<std::string>& endpoints) {
    client::PushSender sender(endpoints, 99);
    for (int n = 0; n < pushes; ++n) {
      client::Push push;
      push.body = static_cast<uint64_t>(1 + n * 7 % kBodies);
      push.kind = client::Push::Kind::kVelocityChange;
      push.linear.y = kPush;
      expected[push.body - 1] += kPush;
      sender.Send(push);
      std::this_thread::sleep_for(milliseconds(1));
    }
    EXPECT_TRUE(sender.Flush(60));
    counts = sender.counts();
    pushed = true;                        // and nobody is killed any more
    const int64_t settled = newest + 60;  // the newest report is less than that old
    std::unique_ptr<client::Client> client;
    const client::Status s = client::Client::Connect(endpoints[0], &client, 20);
    EXPECT_TRUE(s.ok()) << s.message;
    client::WatchOptions exact;
    exact.precision = client::Precision::kExact;
    EXPECT_TRUE(s.ok() && client->Watch(exact).ok() && client->WaitUntilComplete(30));
    std::vector<client::Body> bodies;
    // A server that was killed last may still show what it repeats.
    int64_t tick = 0;
    for (const auto end = Killer::Clock::now() + std::chrono::seconds(30);
         s.ok() && tick < settled && Killer::Clock::now() < end; std::this_thread::sleep_for(milliseconds(10))) {
      client->Latest(&bodies, &tick);
    }
    for (const client::Body& b : bodies) found[b.id] = b.velocity.y;
    seen = true;
  };
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    newest = status.MaxTick();
    if (status.stage != Stage::kRunning || status.MinTick() < 5) return true;
    if (!player.joinable()) {
      std::vector<std::string> endpoints;
      for (const RegionStatus& r : status.regions) endpoints.push_back(r.endpoint);
      player = std::thread([play, endpoints] { play(endpoints); });
    }
    if (!pushed) trouble(status);
    return !seen;
  });
  player.join();
  EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s;
  EXPECT_EQ(counts.rejected, 0);
  EXPECT_EQ(counts.applied, int64_t{pushes});
  ASSERT_EQ(found.size(), size_t{kBodies});
  for (const auto& [id, velocity] : found) EXPECT_EQ(velocity, expected[id - 1]) << "body " << id;
}

TEST_F(Recovery, PushesOfAClientActOnceEachWhileServersDie) {
  Killer killer(3, 12, milliseconds(400));
  bool together = false;
  ExpectPushesActOnce(6000, [&](const RunStatus& status) {
    killer.Look(status);
    // Once, all at the same time: nobody knows then how far the world had come.
    if (!together && killer.killed() >= 4 && status.MinTick() > 100) {
      together = true;
      for (const RegionStatus& r : status.regions) {
        if (r.pid > 0 && r.joined && !r.left) kill(static_cast<pid_t>(r.pid), SIGKILL);
      }
    }
    return true;
  });
  EXPECT_GE(killer.killed(), 6);
  EXPECT_TRUE(together);
}

TEST_F(Recovery, PushesOfAClientActOnceEachWhileServersAndTheirVolumesDie) {
  Destroyer destroyer(directory_ / "data", 4);
  ExpectPushesActOnce(12000, [&](const RunStatus& status) {
    destroyer.Look(status);
    return true;
  });
  EXPECT_GE(destroyer.destroyed(), 3) << events_;
}

TEST_F(Recovery, LostVolumesChangeNoBit) {
  const RunOptions options = OptionsFor("corner-storm.json", 900);
  Destroyer destroyer(directory_ / "data", 4);
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    destroyer.Look(status);
    return true;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_GE(destroyer.destroyed(), 3) << events_;
  EXPECT_TRUE(Happened("CopyFetched, region 0: goes on from the copy at region 1, of tick ")) << events_;
  ExpectExact(options);
}

// Its keeper is recovered first, from its own volume, which has the copy.
TEST_F(Recovery, LostVolumeIsRecoveredThoughItsKeeperDiesToo) {
  const RunOptions options = OptionsFor("demo.json", 300);
  bool killed = false;
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    if (killed || !AllHaveCopies(status)) return true;
    killed = true;
    const RegionStatus &lost = status.regions[3], &keeper = status.regions[0];
    EXPECT_EQ(kill(static_cast<pid_t>(lost.pid), SIGKILL), 0);
    EXPECT_EQ(kill(static_cast<pid_t>(keeper.pid), SIGKILL), 0);
    fs::remove_all(directory_ / "data/region-3");
    return true;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_TRUE(Happened("region 3: goes on from the copy at region 0")) << events_;
  ExpectExact(options);
}

TEST_F(Recovery, StaleVolumeIsNotUsed) {
  const RunOptions options = OptionsFor("demo.json", 600);
  const fs::path data = directory_ / "data/region-1", stale = directory_ / "stale";
  enum { kBegins, kLost, kStale } phase = kBegins;
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    const auto pid = static_cast<pid_t>(status.regions[1].pid);
    if (!AllHaveCopies(status)) return true;
    if (phase == kBegins) {
      phase = kLost;
      EXPECT_EQ(kill(pid, SIGKILL), 0);
      fs::rename(data, stale);
    } else if (phase == kLost && status.regions[1].incarnation == 2) {
      phase = kStale;  // another node, which ran the region once
      EXPECT_EQ(kill(pid, SIGKILL), 0);
      fs::remove_all(data);
      fs::rename(stale, data);
    }
    return true;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_EQ(phase, kStale);
  EXPECT_TRUE(Happened("/i1 is stale: incarnation 2 has gone on elsewhere")) << events_;
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
  EXPECT_NE(events_.find("RegionEnded, region 1: incarnation 1 is ended: nothing heard of it for"), std::string::npos)
      << events_;
  EXPECT_NE(events_.find("RegionReplaced, region 1: incarnation 2 is started"), std::string::npos) << events_;
  ExpectExact(options);
}

// Nothing that it does after it has been replaced is seen by anybody, or found by those after it.
TEST_F(Recovery, ServerThatCannotBeEndedIsFenced) {
  const RunOptions options = OptionsFor("corner-storm.json", 500);
  CutOffAllocator allocator({"", directory_ / "logs", false, directory_ / "data"});
  pid_t frozen = 0;
  bool woken = false, lost = false;
  const absl::Status s = RunWorld(
      options, allocator,
      [&](const RunStatus& status) {
        const RegionStatus& r = status.regions[1];
        if (frozen == 0 && status.stage == Stage::kRunning && status.MinTick() > 60) {
          frozen = static_cast<pid_t>(r.pid);
          EXPECT_EQ(kill(frozen, SIGSTOP), 0);
        } else if (!woken && r.incarnation == 2 && r.ready) {
          woken = true;
          EXPECT_EQ(kill(frozen, SIGCONT), 0);
        } else if (woken && !lost && status.MinTick() > 250) {
          lost = true;
          allocator.End(2, status.regions[2].incarnation);  // it runs as well as ever
        }
        return true;
      },
      &result_);
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_EQ(result_.status.regions[1].incarnation, 2u);
  EXPECT_EQ(result_.status.regions[2].incarnation, 2u);
  ExpectExact(options);
}

TEST_F(Recovery, DamagedCheckpointIsReplacedByTheCopy) {
  const RunOptions options = OptionsFor("demo.json", 300);
  bool killed = false;
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    if (killed || !AllHaveCopies(status)) return true;
    killed = true;
    const auto pid = static_cast<pid_t>(status.regions[3].pid);
    EXPECT_EQ(kill(pid, SIGSTOP), 0);
    Damage(directory_ / "data/region-3/i1/checkpoint");
    EXPECT_EQ(kill(pid, SIGKILL), 0);
    return true;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_TRUE(Happened("region 3: goes on from the copy at region 0, of tick ")) << events_;
  EXPECT_TRUE(Happened("/checkpoint: the checkpoint's check sum is wrong")) << events_;
  ExpectExact(options);
}

TEST_F(Recovery, DamagedCheckpointAndCopyEndTheRunAndAreNamed) {
  const RunOptions options = OptionsFor("demo.json", 0);
  bool killed = false;
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    if (killed || !AllHaveCopies(status)) return true;
    killed = true;
    const auto pid = static_cast<pid_t>(status.regions[3].pid);
    EXPECT_EQ(kill(pid, SIGSTOP), 0);
    std::this_thread::sleep_for(milliseconds(100));  // what is under way to the copy is there
    Damage(directory_ / "data/region-3/i1/checkpoint");
    Damage(directory_ / "data/region-0/copies/region-3/i1/checkpoint");
    EXPECT_EQ(kill(pid, SIGKILL), 0);
    return true;
  });
  EXPECT_EQ(s.code(), absl::StatusCode::kAborted) << s;
  EXPECT_NE(
      s.message().find("data/region-3/i2/checkpoint: the checkpoint's check sum is wrong; and no copy at region 0: "),
      std::string::npos)
      << s;
  EXPECT_NE(s.message().find("copies/region-3/"), std::string::npos) << s;
}

TEST_F(Recovery, RegionWithoutACopyGoesOnAndSaysSo) {
  const RunOptions options = OptionsFor("demo.json", 500);
  const fs::path copies = directory_ / "data/region-2/copies", away = directory_ / "away";
  enum { kBegins, kAway, kBack } phase = kBegins;
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    if (phase == kBegins && AllHaveCopies(status)) {
      fs::rename(copies, away);
      std::ofstream{copies} << "in the way";
      phase = kAway;
    } else if (phase == kAway && Happened("region 1: is not protected by a copy")) {
      fs::remove(copies);
      fs::rename(away, copies);
      phase = kBack;
    }
    return true;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_TRUE(Happened("CopyLost, region 1: is not protected by a copy: its keeper, region 2: ")) << events_;
  EXPECT_TRUE(Happened("CopyRecovered, region 1: is protected by a copy again")) << events_;
  EXPECT_FALSE(Happened("is not protected by checkpoints")) << events_;
  EXPECT_GT(result_.status.regions[1].report.copy_failures(), 0);
  ExpectExact(options);
}

TEST_F(Recovery, RegionThatCannotWriteGoesOnAndSaysSo) {
  const RunOptions options = OptionsFor("demo.json", 300);
  const fs::path data = directory_ / "data/region-1", away = directory_ / "data/away";
  enum { kBefore, kAway, kBack } phase = kBefore;
  const absl::Status s = Run(options, [&](const RunStatus& status) {
    if (phase == kBefore && status.MinTick() > 60) {
      fs::rename(data, away);
      phase = kAway;
    } else if (phase == kAway && Happened("region 1: is not protected by checkpoints")) {
      fs::rename(away, data);
      phase = kBack;
    }
    return true;
  });
  ASSERT_TRUE(s.ok()) << s;
  EXPECT_NE(events_.find("StorageFailed, region 1: is not protected by checkpoints: cannot write " + data.string()),
            std::string::npos)
      << events_;
  EXPECT_NE(events_.find("StorageRecovered, region 1: is protected by checkpoints again"), std::string::npos)
      << events_;
  EXPECT_GT(result_.status.regions[1].report.storage_failures(), 0);
  ExpectExact(options);
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
