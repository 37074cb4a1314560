// Runs whose layout changes: servers are started and leave as operators want it, and every body is where the undivided
// world has it, also while servers are killed.
#include <gtest/gtest.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>

#include "server/control/layout_desk.h"
#include "server/control/layout_plan.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/world_file.h"
#include "server/transport/world_spec.h"
#include "tests/e2e/killer.h"

namespace aureole {
namespace {

namespace fs = std::filesystem;
using std::chrono::milliseconds;

class LayoutRunTest : public testing::Test {
 protected:
  LayoutRunTest() {
    std::string name = (fs::temp_directory_path() / "layout-run-test-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
    absl::StatusOr<WorldFile> file = OpenWorldFile(AUREOLE_WORLDS "/corner-storm.json");
    EXPECT_TRUE(file.ok()) << file.status();
    v1::WorldSpec spec = file->spec;
    spec.mutable_layout()->mutable_columns()->add_edges(0);
    absl::StatusOr<World> world = WorldFromSpec(spec);
    EXPECT_TRUE(world.ok()) << world.status();
    world_ = std::make_unique<World>(*std::move(world));
    desk_ = std::make_unique<LayoutDesk>(*world_);
    options_.world = spec;
    options_.regions = 2;
    options_.hash_every = 5;
    options_.layouts = desk_.get();
  }
  ~LayoutRunTest() override { fs::remove_all(directory_); }

  absl::Status Resize(int columns, int rows = 1) {
    return desk_->Want(
        [&](const LayoutChange& now, const LayoutDesk::State& state) -> absl::StatusOr<std::vector<Rect>> {
          absl::StatusOr<std::vector<Rect>> cells = EqualCells(*world_, columns, rows);
          if (!cells.ok()) return cells;
          return AssignCells(now, *cells, state.leaving);
        });
  }
  absl::Status Drain(RegionId region) {
    return desk_->Want([&](const LayoutChange& now, const LayoutDesk::State&) { return WithoutArea(now, region); });
  }

  // Takes the steps, each as soon as the one before is done and some ticks have passed; then runs on for a while.
  void Run(const std::vector<std::function<void()>>& steps, const RunObserver& look = nullptr) {
    LocalAllocator allocator({"", directory_ / "logs", false, directory_ / "data"});
    size_t next = 0;
    Tick since = 0;
    const auto end = Killer::Clock::now() + std::chrono::seconds(60);
    const absl::Status s = RunWorld(
        options_, allocator,
        [&](const RunStatus& status) {
          if (look != nullptr) look(status);
          if (Killer::Clock::now() > end) return false;
          if (status.stage != Stage::kRunning || desk_->state().changing) {
            since = status.MinTick();
            return true;
          }
          if (status.MinTick() < since + 15) return true;
          if (next == steps.size()) return false;
          since = status.MinTick();
          steps[next++]();
          return true;
        },
        &result_,
        [this](const RunEvent& e) { events_ += "region " + std::to_string(e.region) + ": " + e.what + "\n"; });
    EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s << "\n" << events_;
    EXPECT_EQ(next, steps.size()) << events_;
    EXPECT_EQ(allocator.running(), 0);
  }

  // Of every tick that all have reported.
  void ExpectExact() {
    RunOptions options = options_;
    options.layouts = nullptr;
    options.undivided = options.no_real_time = true;
    options.regions = 1;
    options.checkpoint_every = 0;
    options.last_tick = result_.status.MinTick() / options.hash_every * options.hash_every;
    LocalAllocator allocator({});
    RunResult whole;
    const absl::Status s = RunWorld(
        options, allocator, [](const RunStatus&) { return true; }, &whole);
    ASSERT_TRUE(s.ok()) << s;
    ASSERT_GE(result_.hashes.size(), whole.hashes.size());
    ASSERT_GT(whole.hashes.size(), 10u);
    for (size_t i = 0; i < whole.hashes.size(); ++i) {
      ASSERT_EQ(result_.hashes[i].tick, whole.hashes[i].tick);
      ASSERT_EQ(result_.hashes[i].bodies, whole.hashes[i].bodies) << "tick " << whole.hashes[i].tick << "\n" << events_;
      ASSERT_EQ(result_.hashes[i].hash, whole.hashes[i].hash) << "tick " << whole.hashes[i].tick << "\n" << events_;
    }
    EXPECT_TRUE(result_.violations.empty());
    for (const RegionStatus& r : result_.status.regions) EXPECT_EQ(r.report.refused_frames(), 0);
  }

  std::vector<RegionId> Members() const { return desk_->state().now.members; }

  fs::path directory_;
  std::unique_ptr<World> world_;
  std::unique_ptr<LayoutDesk> desk_;
  RunOptions options_;
  RunResult result_;
  std::string events_;
};

TEST_F(LayoutRunTest, TwoSixThreeServersChangeNoBit) {
  Run({[&] { EXPECT_TRUE(Resize(3, 2).ok()); }, [&] { EXPECT_EQ(Members().size(), 6u); },
       [&] { EXPECT_TRUE(Resize(3).ok()); }, [&] { EXPECT_EQ(Members().size(), 3u); }});
  ExpectExact();
}

TEST_F(LayoutRunTest, TwoSixThreeServersChangeNoBitWhileServersAreKilled) {
  options_.checkpoint_every = 40;
  Killer killer(11, 14, milliseconds(500));
  Run({[&] { EXPECT_TRUE(Resize(3, 2).ok()); }, [&] { EXPECT_EQ(Members().size(), 6u); },
       [&] { EXPECT_TRUE(Resize(3).ok()); }, [&] { EXPECT_EQ(Members().size(), 3u); },
       [&] { EXPECT_TRUE(Resize(2, 2).ok()); }, [&] { EXPECT_EQ(Members().size(), 4u); },
       [&] { EXPECT_TRUE(Drain(0).ok()); }, [&] { EXPECT_EQ(Members().size(), 3u); }},
      [&](const RunStatus& status) {
        killer.Look(status);
        return true;
      });
  EXPECT_GE(killer.killed(), 6) << events_;
  ExpectExact();
}

}  // namespace
}  // namespace aureole
