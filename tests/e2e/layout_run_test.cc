// Runs whose layout changes: servers are started and leave as operators want it, and every body is where the undivided
// world has it, also while servers are killed.
#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <grpcpp/grpcpp.h>

#include <atomic>
#include <cstdlib>
#include <filesystem>
#include <thread>

#include "aureole/v1/control_plane.grpc.pb.h"
#include "aureole/v1/simulation.grpc.pb.h"
#include "server/control/layout_desk.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/sqlite_store.h"
#include "server/control/world_file.h"
#include "server/transport/world_spec.h"
#include "tests/e2e/exact_run.h"
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

  absl::Status Resize(int columns, int rows = 1) { return desk_->Resize(columns, rows); }
  absl::Status Drain(RegionId region) { return desk_->Drain(region); }

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

  // Of every tick that all have reported, from this one on.
  void ExpectExact(Tick from = 0) {
    SCOPED_TRACE(events_);
    ExpectExactSoFar(result_, options_, from);
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

TEST_F(LayoutRunTest, TheNextControlPlaneFinishesWhatTheLastOneHasBegun) {
  options_.checkpoint_every = 40;
  std::atomic<bool> leave = false;
  options_.leave = &leave;
  // Looks of each control plane before it leaves; the last one stays.
  const std::vector<int> looks = {1, 2, 3, 5, 8, 13, 1, 2, 3, 4, 5, 8, 0};
  size_t wishes = 0;
  for (size_t round = 0; round < looks.size(); ++round) {
    absl::StatusOr<std::unique_ptr<SqliteStore>> store = SqliteStore::Open(directory_ / "control.db");
    ASSERT_TRUE(store.ok()) << store.status();
    options_.store = store->get();
    options_.control_epoch = (*store)->epoch();
    LocalAllocator::Options servers;
    servers.log_directory = directory_ / "logs";
    servers.data_directory = directory_ / "data";
    servers.outlive = true;
    LocalAllocator allocator(servers);
    desk_ = std::make_unique<LayoutDesk>(*world_);
    options_.layouts = desk_.get();
    leave = false;
    int seen = 0;
    Tick settled = 0;
    const auto end = Killer::Clock::now() + std::chrono::seconds(40);
    const absl::Status s = RunWorld(
        options_, allocator,
        [&](const RunStatus& status) {
          if (status.stage != Stage::kRunning) return true;
          if (Killer::Clock::now() > end) return false;
          const bool still = !desk_->state().changing && status.MinTick() > 20;
          if (still && wishes < 2) {
            EXPECT_TRUE(Resize(wishes++ == 0 ? 6 : 3).ok());
          }
          leave = round + 1 < looks.size() && ++seen > looks[round];
          if (!still || wishes < 2 || desk_->state().changing) settled = status.MinTick();
          return round + 1 < looks.size() || status.MinTick() < settled + 25;
        },
        &result_,
        [this](const RunEvent& e) { events_ += "region " + std::to_string(e.region) + ": " + e.what + "\n"; });
    ASSERT_EQ(s.code(), absl::StatusCode::kCancelled) << s << "\n" << events_;
  }
  EXPECT_EQ(wishes, 2u);
  EXPECT_EQ(Members().size(), 3u) << events_;
  // Of the last control plane alone.
  RunOptions options = options_;
  options.store = nullptr;
  options.leave = nullptr;
  options_ = options;
  ASSERT_FALSE(result_.hashes.empty());
  ExpectExact(result_.status.MinTick() - 20);
}

TEST_F(LayoutRunTest, OperatorsResizeAndDrainByCalls) {
  std::string control;
  const auto call = [&](auto method, const auto& request, auto* response) {
    const auto stub = v1::ControlPlane::NewStub(grpc::CreateChannel(control, grpc::InsecureChannelCredentials()));
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(10));
    return ((*stub).*method)(&context, request, response);
  };
  using Stub = v1::ControlPlane::Stub;
  const auto resize = [&](int columns) {
    v1::ResizeLayoutRequest request;
    request.set_columns(columns);
    v1::ResizeLayoutResponse response;
    return call(&Stub::ResizeLayout, request, &response);
  };
  const auto drain = [&](RegionId region) {
    v1::DrainRegionRequest request;
    request.set_region(region);
    v1::DrainRegionResponse response;
    return call(&Stub::DrainRegion, request, &response);
  };
  const auto world = [&] {
    v1::ControlledWorld out;
    const grpc::Status s = call(&Stub::GetWorld, v1::GetControlledWorldRequest(), &out);
    EXPECT_TRUE(s.ok()) << s.error_message();
    return out;
  };
  const auto events = [&] {
    const auto stub = v1::ControlPlane::NewStub(grpc::CreateChannel(control, grpc::InsecureChannelCredentials()));
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(10));
    const auto stream = stub->WatchEvents(&context, {});
    std::vector<EventKind> out;
    for (v1::ControlEvent event; stream->Read(&event);) out.push_back(event.kind());
    EXPECT_TRUE(stream->Finish().ok());
    return out;
  };
  std::vector<EventKind> kinds;
  // What a client hears that watches a server which stays.
  std::string server;
  std::vector<v1::GetWorldResponse> heard;
  std::thread watcher;
  const auto watch = [&] {
    const auto stub = v1::Simulation::NewStub(grpc::CreateChannel(server, grpc::InsecureChannelCredentials()));
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(60));
    const auto stream = stub->WatchLayout(&context, {});
    v1::LayoutUpdate update;
    while (stream->Read(&update)) {
      if (update.has_world()) heard.push_back(update.world());
    }
    stream->Finish();
  };
  Run({[&] {
         watcher = std::thread(watch);
         EXPECT_EQ(resize(0).error_code(), grpc::StatusCode::INVALID_ARGUMENT);
         EXPECT_EQ(drain(7).error_code(), grpc::StatusCode::INVALID_ARGUMENT);
         EXPECT_EQ(world().layout_epoch(), 1u);
         EXPECT_TRUE(resize(3).ok());
         EXPECT_TRUE(world().changing());
       },
       [&] {
         EXPECT_EQ(world().regions_size(), 3);
         EXPECT_TRUE(drain(1).ok());
       },
       [&] {
         const v1::ControlledWorld now = world();
         EXPECT_EQ(now.name(), world_->name);
         EXPECT_EQ(now.regions_size(), 3);
         EXPECT_FALSE(now.regions(1).member());
         EXPECT_EQ(now.regions(1).endpoint(), "");
         EXPECT_GT(now.regions(0).tick(), 0);
         EXPECT_FALSE(now.changing());
         kinds = events();
       }},
      [&](const RunStatus& status) {
        control = status.control;
        server = status.regions[0].endpoint;
        return true;
      });
  watcher.join();
  using Event = v1::ControlEvent;
  EXPECT_EQ(kinds, (std::vector<EventKind>{Event::LAYOUT_PROPOSED, Event::REGION_JOINS, Event::LAYOUT_IN_FORCE,
                                           Event::LAYOUT_PROPOSED, Event::LAYOUT_IN_FORCE, Event::LAYOUT_PROPOSED,
                                           Event::REGION_LEAVES, Event::LAYOUT_IN_FORCE, Event::REGION_LEFT}));
  // Begun, three columns, one without area, two columns.
  ASSERT_EQ(heard.size(), 4u);
  for (size_t i = 0; i < heard.size(); ++i) EXPECT_EQ(heard[i].layout_epoch(), i + 1);
  EXPECT_EQ(heard[0].endpoints_size(), 2);
  EXPECT_EQ(heard[1].endpoints_size(), 3);
  EXPECT_NE(heard[2].endpoints(1), "");
  EXPECT_EQ(heard[2].layout(1).min_x(), heard[2].layout(1).max_x());
  EXPECT_EQ(heard[3].endpoints(0), server);
  EXPECT_EQ(heard[3].endpoints(1), "");
  EXPECT_EQ(heard[3].endpoints(2), heard[1].endpoints(2));
  ExpectExact();
}

TEST_F(LayoutRunTest, ServerThatDiesGoesOnFromTheCheckpointThatWasAskedFor) {
  options_.checkpoint_every = 1'000'000;  // none by itself
  std::atomic<bool> answered = false;
  v1::SaveCheckpointResponse saved;
  grpc::Status said;
  std::thread operator_;
  Tick at_call = 0, resumed = -1;
  pid_t killed = 0;
  LocalAllocator allocator({"", directory_ / "logs", false, directory_ / "data"});
  const auto end = Killer::Clock::now() + std::chrono::seconds(60);
  const absl::Status s = RunWorld(
      options_, allocator,
      [&](const RunStatus& status) {
        if (Killer::Clock::now() > end) return false;
        if (status.stage != Stage::kRunning || status.MinTick() < 30) return true;
        const RegionStatus& r = status.regions[0];
        if (!operator_.joinable()) {
          at_call = status.MaxTick();
          operator_ = std::thread([&, control = status.control] {
            const auto stub =
                v1::ControlPlane::NewStub(grpc::CreateChannel(control, grpc::InsecureChannelCredentials()));
            grpc::ClientContext context;
            context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(20));
            v1::SaveCheckpointRequest request;
            request.set_copied(true);
            said = stub->SaveCheckpoint(&context, request, &saved);
            answered = true;
          });
        } else if (answered && killed == 0) {
          killed = static_cast<pid_t>(r.pid);
          kill(killed, SIGKILL);
        } else if (killed != 0 && resumed < 0 && r.incarnation == 2 && r.ready) {
          resumed = r.report.tick();
        }
        return resumed < 0 || status.MinTick() < saved.tick() + 60;
      },
      &result_);
  if (operator_.joinable()) operator_.join();
  EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s;
  ASSERT_TRUE(said.ok()) << said.error_message();
  EXPECT_GT(saved.tick(), at_call);
  ASSERT_EQ(saved.regions_size(), 2);
  for (const v1::SavedRegion& r : saved.regions()) {
    EXPECT_EQ(r.tick(), saved.tick()) << "region " << r.region() << ": all hear of it in time";
    EXPECT_EQ(r.copied_tick(), saved.tick());
  }
  EXPECT_GE(resumed, saved.tick());
  ExpectExact();
}

}  // namespace
}  // namespace aureole
