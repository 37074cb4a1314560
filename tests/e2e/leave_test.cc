// Servers that are told to end (SIGTERM) while their world runs: the region leaves, another one takes its place, and
// the world does not stop; where it cannot leave, its server is replaced as if it had died. Every body is where the
// undivided world has it.
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <filesystem>
#include <functional>
#include <iostream>
#include <optional>
#include <random>

#include "server/control/layout_desk.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/sqlite_store.h"
#include "server/transport/health_check.h"
#include "server/transport/world_spec.h"
#include "tests/e2e/exact_run.h"
#include "tests/e2e/frame_watcher.h"

namespace aureole {
namespace {

namespace fs = std::filesystem;
using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;
using std::chrono::seconds;

// A replacement from a checkpoint takes longer; a busy machine less.
constexpr double kLongestStop = 0.3;

// A machine on which regions from `from` on get no server until there is room.
class FullMachine final : public Allocator {
 public:
  FullMachine(LocalAllocator::Options options, RegionId from) : servers_(std::move(options)), from_(from) {}

  absl::Status Start(const ServerStart& start) override {
    if (start.region < from_ || room) return servers_.Start(start);
    waiting_.push_back(start);
    return absl::OkStatus();
  }
  std::vector<ServerExit> Poll() override {
    for (; room && !waiting_.empty(); waiting_.pop_back()) EXPECT_TRUE(servers_.Start(waiting_.back()).ok());
    std::vector<ServerExit> out = servers_.Poll();
    out.insert(out.end(), ended_.begin(), ended_.end());
    ended_.clear();
    return out;
  }
  int running() const override { return servers_.running() + static_cast<int>(waiting_.size()); }
  void End(RegionId region, uint64_t incarnation) override {
    const auto waits = [&](const ServerStart& s) { return s.region == region && s.incarnation == incarnation; };
    if (std::erase_if(waiting_, waits) == 0) return servers_.End(region, incarnation);
    ServerExit exit;
    exit.region = region;
    exit.incarnation = incarnation;
    exit.how = "killed before it began";
    ended_.push_back(exit);
  }
  void Kill() override {
    waiting_.clear();
    servers_.Kill();
  }
  bool room = false;

 private:
  LocalAllocator servers_;
  const RegionId from_;
  std::vector<ServerStart> waiting_;
  std::vector<ServerExit> ended_;
};

class Leave : public testing::Test {
 protected:
  Leave() {
    std::string name = (fs::temp_directory_path() / "leave-test-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
    servers_.log_directory = directory_ / "logs";
    servers_.data_directory = directory_ / "data";
    Load("corner-storm.json");
  }
  ~Leave() override { fs::remove_all(directory_); }

  // A world of tests/worlds; `edges`: of columns, instead of its own layout.
  void Load(const std::string& file, std::optional<std::vector<double>> edges = std::nullopt, int delay = 0) {
    options_ = OptionsFor(file, 0, 5, 30);
    if (edges.has_value()) {
      options_.world.mutable_layout()->mutable_columns()->clear_edges();
      for (double edge : *edges) options_.world.mutable_layout()->mutable_columns()->add_edges(edge);
      options_.regions = static_cast<int>(edges->size()) + 1;
    }
    if (delay > 0) options_.world.mutable_exchange()->set_delay(static_cast<uint32_t>(delay));
    absl::StatusOr<World> world = WorldFromSpec(options_.world);
    ASSERT_TRUE(world.ok()) << world.status();
    world_ = std::make_unique<World>(*std::move(world));
    desk_ = std::make_unique<LayoutDesk>(*world_);
    options_.layouts = desk_.get();
  }

  // Takes the steps, each once the layout is as it is wanted, all members tick and some ticks have passed; then runs on
  // for a while.
  using Step = std::function<void(const RunStatus&)>;
  void Run(const std::vector<Step>& steps, const Step& look = nullptr) {
    LocalAllocator allocator(servers_);
    RunWith(allocator, steps, look);
  }
  void RunWith(Allocator& allocator, const std::vector<Step>& steps, const Step& look = nullptr) {
    size_t next = 0;
    Tick since = 0;
    const auto end = Clock::now() + seconds(60);
    FrameWatcher watcher;
    const absl::Status s = RunWorld(
        options_, allocator,
        [&](const RunStatus& status) {
          watcher.Look(status);
          if (look != nullptr) look(status);
          if (Clock::now() > end) return false;
          const bool all = std::all_of(status.regions.begin(), status.regions.end(), [](const RegionStatus& r) {
            return !r.leaves_by.has_value() && (!r.member || (r.ready && !r.left && !r.report.replaying()));
          });
          if (status.stage != Stage::kRunning || desk_->state().changing || !all) {
            since = status.MinTick();
            return true;
          }
          if (status.MinTick() < since + 20) return true;
          if (next == steps.size()) {
            watcher.End();
            return false;
          }
          since = status.MinTick();
          steps[next++](status);
          return true;
        },
        &result_,
        [this](const RunEvent& e) { events_ += "region " + std::to_string(e.region) + ": " + e.what + "\n"; });
    EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s << "\n" << events_;
    EXPECT_EQ(next, steps.size()) << events_;
    EXPECT_EQ(allocator.running(), 0);
    EXPECT_GT(watcher.frames(), 40);
    longest_stop_ = watcher.longest_stop().count();
    RecordProperty("longest_stop_ms", static_cast<int>(1000 * longest_stop_));
    std::cerr << "longest stop " << longest_stop_ << " s\n";
  }

  static void Tell(const RunStatus& status, RegionId region, int signal = SIGTERM) {
    EXPECT_EQ(kill(static_cast<pid_t>(status.regions[static_cast<size_t>(region)].pid), signal), 0);
  }
  // Regions without area are left out.
  std::vector<RegionId> Members() const { return desk_->state().now.members; }
  size_t Events(const std::string& what) const {
    size_t count = 0;
    for (size_t at = 0; (at = events_.find(what, at)) != std::string::npos; ++at) ++count;
    return count;
  }
  // No server went on from a checkpoint, and the world did not stop.
  void ExpectNothingWasRepeated() const {
    EXPECT_EQ(Events(" is started: "), Events(" is started: the region joins the world")) << events_;
    EXPECT_LT(longest_stop_, kLongestStop) << events_;
  }

  fs::path directory_;
  LocalAllocator::Options servers_;
  std::unique_ptr<World> world_;
  std::unique_ptr<LayoutDesk> desk_;
  RunOptions options_;
  RunResult result_;
  std::string events_;
  double longest_stop_ = 0;
};

TEST_F(Leave, EachServerInTurnAndTheWorldDoesNotStop) {
  std::vector<Rect> homes = desk_->state().now.regions;
  std::vector<Step> steps;
  for (RegionId r = 0; r < 4; ++r) steps.push_back([r](const RunStatus& status) { Tell(status, r); });
  Run(steps);
  EXPECT_EQ(Events("leaves: its server was told to end"), 4u) << events_;
  EXPECT_EQ(Events("has left"), 4u) << events_;
  EXPECT_EQ(Members(), (std::vector<RegionId>{0, 1, 2, 4})) << "the first leaves to 4, and then each to the one before";
  std::vector<Rect> now = desk_->state().now.regions;
  std::erase_if(now, [](const Rect& r) { return !r.HasArea(); });
  EXPECT_TRUE(std::is_permutation(now.begin(), now.end(), homes.begin(), homes.end()));
  ExpectNothingWasRepeated();
  ExpectExactSoFar(result_, options_);
}

TEST_F(Leave, AllServersAtOnce) {
  Load("corner-storm.json", {{0}});
  Run({[](const RunStatus& status) {
    Tell(status, 0);
    Tell(status, 1);
  }});
  EXPECT_EQ(Members(), (std::vector<RegionId>{2, 3})) << events_;
  ExpectNothingWasRepeated();
  ExpectExactSoFar(result_, options_);
}

TEST_F(Leave, TheOnlyServer) {
  Load("corner-storm.json", std::vector<double>());
  Run({[](const RunStatus& status) { Tell(status, 0); }});
  EXPECT_EQ(Members(), std::vector<RegionId>{1}) << events_;
  ExpectNothingWasRepeated();
  ExpectExactSoFar(result_, options_);
}

TEST_F(Leave, ANeighbourHasTheAreaUntilThereIsRoomForAnother) {
  servers_.flags = {"--leave-within", "5"};
  FullMachine machine(servers_, 4);
  const std::vector<Rect> homes = desk_->state().now.regions;
  bool told = false;
  RunWith(machine, {[](const RunStatus& status) { Tell(status, 1); }}, [&](const RunStatus& status) {
    machine.room = Events("region 1: has left") > 0;
    if (status.regions.size() < 2 || !status.regions[1].leaves_by.has_value()) return;
    if (std::exchange(told, true)) return;
    EXPECT_TRUE(CheckHealth(status.regions[0].endpoint, grpc::InsecureChannelCredentials()).ok());
    EXPECT_FALSE(CheckHealth(status.regions[1].endpoint, grpc::InsecureChannelCredentials()).ok()) << "it is ready";
  });
  EXPECT_TRUE(told);
  EXPECT_EQ(Events("region 4: does not come in time"), 1u) << events_;
  EXPECT_EQ(Members(), (std::vector<RegionId>{0, 2, 3, 4})) << events_;
  EXPECT_EQ(desk_->state().now.regions[4], homes[1]);
  ExpectNothingWasRepeated();
  ExpectExactSoFar(result_, options_);
}

TEST_F(Leave, WhereNobodyCanTakeOverServersAreReplaced) {
  Load("corner-storm.json", {{0}});
  servers_.flags = {"--leave-within", "2"};
  FullMachine machine(servers_, 2);
  RunWith(machine, {[](const RunStatus& status) {
            Tell(status, 0);
            Tell(status, 1);
          }});
  EXPECT_EQ(Members(), (std::vector<RegionId>{0, 1})) << events_;
  EXPECT_EQ(Events("incarnation 2 is started: exit status 0"), 2u) << events_;
  EXPECT_EQ(Events("did not leave; it keeps its place"), 2u) << events_;
  ExpectExactSoFar(result_, options_);
}

TEST_F(Leave, TheSecondSignalEndsAServerAtOnce) {
  bool again = false;
  Run({[](const RunStatus& status) { Tell(status, 2); }}, [&](const RunStatus& status) {
    if (again || status.regions.size() < 3 || !status.regions[2].leaves_by.has_value()) return;
    again = true;
    Tell(status, 2);
  });
  EXPECT_EQ(Events("incarnation 2 is started: exit status 0"), 1u) << events_;
  ExpectExactSoFar(result_, options_);
}

TEST_F(Leave, WhereTheExchangeHasADelayServersAreReplaced) {
  Load("border-pile.json", std::nullopt, 1);
  Run({[](const RunStatus&) {}, [](const RunStatus& status) { Tell(status, 1); }});
  EXPECT_EQ(Events("incarnation 2 is started: exit status 0"), 1u) << events_;
  ExpectExactSoFar(result_, options_);
}

TEST_F(Leave, WhereTheLayoutStaysAsItIsServersAreReplaced) {
  Load("border-pile.json");
  options_.layouts = nullptr;
  Run({[](const RunStatus&) {}, [](const RunStatus& status) { Tell(status, 1); }});
  EXPECT_EQ(Events("incarnation 2 is started: exit status 0"), 1u) << events_;
  ExpectExactSoFar(result_, options_);
}

TEST_F(Leave, ServersThatAreKilledMeanwhileAreReplaced) {
  std::mt19937 random(7);
  Clock::time_point at = Clock::time_point::max();
  int killed = 0;
  Step leave = [&](const RunStatus& status) {
    const std::vector<RegionId> members = Members();
    Tell(status, members[random() % members.size()]);
    at = Clock::now() + milliseconds(random() % 600);
  };
  Run(std::vector<Step>(5, leave), [&](const RunStatus& status) {
    if (Clock::now() < at) return;
    at = Clock::time_point::max();
    for (const bool leaving : {true, false}) {
      for (const RegionStatus& r : status.regions) {
        if (r.leaves_by.has_value() != leaving || !r.ready || r.left || r.pid <= 0 || random() % 2 == 0) continue;
        killed += kill(static_cast<pid_t>(r.pid), SIGKILL) == 0 ? 1 : 0;
        return;
      }
    }
  });
  EXPECT_GE(killed, 2) << events_;
  EXPECT_EQ(Members().size(), 4u) << events_;
  ExpectExactSoFar(result_, options_);
}

// Several control planes, one after another, with one store.
class LeaveAcrossControlPlanes : public Leave {
 protected:
  // `leave_after`: looks at the world that runs; 0: until the layout has been as it is wanted for a while.
  void RunOne(int leave_after, const Step& look = nullptr) {
    absl::StatusOr<std::unique_ptr<SqliteStore>> store = SqliteStore::Open(directory_ / "control.db");
    ASSERT_TRUE(store.ok()) << store.status();
    options_.store = store->get();
    options_.control_epoch = (*store)->epoch();
    std::atomic<bool> leave = false;
    options_.leave = &leave;
    servers_.outlive = true;
    LocalAllocator allocator(servers_);
    desk_ = std::make_unique<LayoutDesk>(*world_);
    options_.layouts = desk_.get();
    int looks = 0;
    Tick settled = 0;
    const auto end = Clock::now() + seconds(40);
    const absl::Status s = RunWorld(
        options_, allocator,
        [&](const RunStatus& status) {
          if (Clock::now() > end) return false;
          if (status.stage != Stage::kRunning) return true;
          if (look != nullptr) look(status);
          const bool all = std::all_of(status.regions.begin(), status.regions.end(), [](const RegionStatus& r) {
            return !r.leaves_by.has_value() && (!r.member || (r.ready && !r.left && !r.report.replaying()));
          });
          if (desk_->state().changing || !all) settled = status.MinTick();
          leave = leave_after > 0 && ++looks >= leave_after;
          return leave_after > 0 || status.MinTick() < settled + 25;
        },
        &result_,
        [this](const RunEvent& e) { events_ += "region " + std::to_string(e.region) + ": " + e.what + "\n"; });
    ASSERT_EQ(s.code(), absl::StatusCode::kCancelled) << s << "\n" << events_;
    ASSERT_LT(Clock::now(), end) << events_;
  }
};

TEST_F(LeaveAcrossControlPlanes, AServerThatIsToldToEndWaitsForTheNextOne) {
  RunOne(10);
  Tell(result_.status, 3);
  RunOne(0);
  EXPECT_EQ(Members(), (std::vector<RegionId>{0, 1, 2, 4})) << events_;
  EXPECT_EQ(Events("leaves: its server was told to end"), 1u) << events_;
  EXPECT_EQ(Events(" is started: "), 0u) << events_;
  ExpectExactSoFar(result_, options_, result_.status.MinTick() - 20);
}

TEST_F(LeaveAcrossControlPlanes, AServerForWhichNoneComesEndsAndIsReplaced) {
  servers_.flags = {"--leave-within", "0.5"};
  RunOne(10);
  const auto pid = static_cast<pid_t>(result_.status.regions[3].pid);
  Tell(result_.status, 3);
  EXPECT_EQ(waitpid(pid, nullptr, 0), pid);
  RunOne(0);
  EXPECT_EQ(Members(), (std::vector<RegionId>{0, 1, 2, 3})) << events_;
  EXPECT_EQ(result_.status.regions[3].incarnation, 2u) << events_;
  ExpectExactSoFar(result_, options_, result_.status.MinTick() - 20);
}

TEST_F(LeaveAcrossControlPlanes, EachGoesOnWithWhatTheLastOneHasBegun) {
  bool told = false;
  RunOne(3, [&told](const RunStatus& status) {
    if (!std::exchange(told, true)) Tell(status, 0);
  });
  for (const int looks : {1, 2, 1, 3, 2, 5}) RunOne(looks);
  RunOne(0);
  EXPECT_EQ(Members().size(), 4u) << events_;
  EXPECT_EQ(Members().front(), 1) << events_;
  EXPECT_EQ(Events(" is started: exit"), 0u) << events_;
  ExpectExactSoFar(result_, options_, result_.status.MinTick() - 20);
}

}  // namespace
}  // namespace aureole
