// A client that stays connected while the layout of its world changes: servers come, go, die, and come back elsewhere.
#include "aureole/client.h"

#include <arpa/inet.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <signal.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <filesystem>
#include <functional>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "server/control/layout_desk.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/transport/world_spec.h"
#include "tests/e2e/running_world.h"

namespace aureole {
namespace {

namespace fs = std::filesystem;
using client::Body;
using client::Client;
using client::Push;
using namespace std::chrono_literals;

constexpr int kBodies = 24;
constexpr double kPush = 1.0 / 1024;  // m/s: sums are exact
constexpr auto kPatience = 60s;

// Two columns, and bodies in lanes of their own.
v1::WorldSpec TwoRegions() {
  v1::WorldSpec spec = Lanes(kBodies);
  spec.mutable_layout()->mutable_columns()->clear_edges();
  spec.mutable_layout()->mutable_columns()->add_edges(0);
  return spec;
}

// A port of this machine that no server can have.
class Port {
 public:
  // As soon as it is free.
  explicit Port(const std::string& endpoint) : socket_(socket(AF_INET, SOCK_STREAM, 0)) {
    const int on = 1;
    setsockopt(socket_, SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on));
    sockaddr_in address = {};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    address.sin_port = htons(static_cast<uint16_t>(std::stoi(endpoint.substr(endpoint.rfind(':') + 1))));
    for (const auto end = std::chrono::steady_clock::now() + 1s; !taken_ && std::chrono::steady_clock::now() < end;) {
      taken_ =
          bind(socket_, reinterpret_cast<const sockaddr*>(&address), sizeof(address)) == 0 && listen(socket_, 1) == 0;
      if (!taken_) std::this_thread::sleep_for(1ms);
    }
  }
  ~Port() { close(socket_); }
  bool taken() const { return taken_; }

 private:
  const int socket_;
  bool taken_ = false;
};

// A world that runs while the test does what operators and faults do.
class ChangingWorld {
 public:
  explicit ChangingWorld(Tick checkpoint_every = 0) {
    std::string name = (fs::temp_directory_path() / "client-layouts-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
    options_.world = TwoRegions();
    options_.regions = 2;
    options_.checkpoint_every = checkpoint_every;
    absl::StatusOr<World> world = WorldFromSpec(options_.world);
    EXPECT_TRUE(world.ok()) << world.status();
    world_ = std::make_unique<World>(*std::move(world));
    desk_ = std::make_unique<LayoutDesk>(*world_);
    options_.layouts = desk_.get();
    thread_ = std::thread([this] { Run(); });
    EXPECT_TRUE(Await([this] { return status_.stage == Stage::kRunning && status_.MinTick() > 5; }));
  }
  ~ChangingWorld() {
    ended_ = true;
    thread_.join();
    fs::remove_all(directory_);
  }

  LayoutDesk& desk() { return *desk_; }
  RunStatus status() {
    const std::lock_guard lock(mutex_);
    return status_;
  }
  std::set<std::string> Endpoints() {
    std::set<std::string> out;
    const RunStatus now = status();
    for (RegionId r : desk_->state().now.members) out.insert(now.regions[static_cast<size_t>(r)].endpoint);
    return out;
  }

  // Until the layout is what was wanted, and all that are in it have gone on.
  void AwaitStill() {
    EXPECT_TRUE(Await([this] { return !desk_->state().changing; }));
    Tick tick = 0;
    EXPECT_TRUE(Await([&] {
      tick = status_.MinTick();
      return tick > 0;
    }));
    EXPECT_TRUE(Await([&] { return status_.MinTick() > tick + 15; })) << "the world stands still";
  }
  // The region's server dies, and its port is lost; until another server has gone further elsewhere.
  void Replace(RegionId r) {
    const RegionStatus before = status().regions[static_cast<size_t>(r)];
    ASSERT_EQ(kill(static_cast<pid_t>(before.pid), SIGKILL), 0);
    ports_.push_back(std::make_unique<Port>(before.endpoint));
    EXPECT_TRUE(ports_.back()->taken());
    EXPECT_TRUE(Await([&] {
      const RegionStatus& now = status_.regions[static_cast<size_t>(r)];
      return now.incarnation > before.incarnation && now.report.tick() > before.report.tick() + 20;
    })) << "region "
        << r << " has not been replaced";
  }

 private:
  bool Await(const std::function<bool()>& condition) {
    std::unique_lock lock(mutex_);
    return changed_.wait_for(lock, kPatience, condition);
  }
  void Run() {
    LocalAllocator allocator({"", directory_ / "logs", false, directory_ / "data"});
    RunResult result;
    const absl::Status s = RunWorld(
        options_, allocator,
        [this](const RunStatus& status) {
          {
            const std::lock_guard lock(mutex_);
            status_ = status;
          }
          changed_.notify_all();
          return !ended_;
        },
        &result);
    EXPECT_EQ(s.code(), absl::StatusCode::kCancelled) << s;
    EXPECT_EQ(allocator.running(), 0);
  }

  fs::path directory_;
  std::vector<std::unique_ptr<Port>> ports_;
  RunOptions options_;
  std::unique_ptr<World> world_;
  std::unique_ptr<LayoutDesk> desk_;
  std::mutex mutex_;
  std::condition_variable changed_;
  RunStatus status_;
  std::atomic<bool> ended_ = false;
  std::thread thread_;
};

// Looks at the world and pushes its bodies upwards, all the time.
class Player {
 public:
  explicit Player(const std::string& server) : expected_(kBodies, 0) {
    const client::Status s = Client::Connect(server, &client_);
    EXPECT_TRUE(s.ok()) << s.message;
    client::WatchOptions exact;
    exact.precision = client::Precision::kExact;
    EXPECT_TRUE(client_->Watch(exact).ok());
    EXPECT_TRUE(client_->WaitUntilComplete(10));
    thread_ = std::thread([this] { Play(); });
  }
  ~Player() {
    if (thread_.joinable()) Stop();
  }

  Client& client() { return *client_; }

  // What it has seen is right, and what it has done has been done once.
  void ExpectAllWasWell() {
    Stop();
    EXPECT_EQ(fewest_, size_t{kBodies}) << "a body was not seen for a while";
    EXPECT_EQ(most_, size_t{kBodies}) << "a body was seen that is none";
    client::PushCounts counts;
    ASSERT_TRUE(client_->Flush(30, &counts).ok());
    EXPECT_EQ(counts.rejected, 0) << counts.reasons[0].first;
    EXPECT_EQ(counts.applied, pushes_);
    EXPECT_GT(pushes_, 300);
    // Exactly this often, on every body; and what is seen is new.
    std::vector<Body> bodies;
    const auto right = [&] {
      client_->Latest(&bodies);
      return std::all_of(bodies.begin(), bodies.end(),
                         [&](const Body& b) { return b.velocity.y == expected_[b.id - 1]; });
    };
    for (const auto end = std::chrono::steady_clock::now() + 15s; !right() && std::chrono::steady_clock::now() < end;) {
      std::this_thread::sleep_for(5ms);
    }
    for (const Body& b : bodies) EXPECT_EQ(b.velocity.y, expected_[b.id - 1]) << b.id;
  }

  // How often the tick of what is seen went back. After it is stopped.
  int64_t backwards() const { return backwards_; }

  // These servers, and no others: what is seen goes on with them.
  void ExpectServers(const std::set<std::string>& endpoints) {
    std::set<std::string> known;
    for (const auto end = std::chrono::steady_clock::now() + 15s;
         known != endpoints && std::chrono::steady_clock::now() < end;) {
      known.clear();
      for (const auto& r : client_->world().regions) {
        if (!r.endpoint.empty()) known.insert(r.endpoint);
      }
      std::this_thread::sleep_for(5ms);
    }
    EXPECT_EQ(known, endpoints);
    EXPECT_TRUE(client_->WaitUntilComplete(15));
    std::vector<Body> bodies;
    int64_t from = 0, tick = 0;
    client_->Latest(&bodies, &from);
    const auto goes_on = [&] {
      client_->Latest(&bodies, &tick);
      return tick > from + 15 && client_->real_time_factor() > 0.5;
    };
    for (const auto end = std::chrono::steady_clock::now() + 15s;
         !goes_on() && std::chrono::steady_clock::now() < end;) {
      std::this_thread::sleep_for(5ms);
    }
    EXPECT_GT(tick, from + 15);
    EXPECT_GT(client_->real_time_factor(), 0.5);
  }

  // A body comes, is hit by a ray, and goes.
  void ExpectSpawnRayAndRemove() {
    client::NewBody box;
    box.shape.kind = client::Shape::Kind::kBox;
    box.shape.size = {2, 2, 2};
    box.position = {3, 500, 7};
    std::vector<uint64_t> ids;
    client::Status s = client_->Spawn({box}, &ids);
    ASSERT_TRUE(s.ok()) << s.message;
    client::RayHit hit;
    s = client_->CastRay({3, 520, 7}, {0, -1, 0}, 100, &hit, 10);
    ASSERT_TRUE(s.ok()) << s.message;
    EXPECT_EQ(hit.body, ids[0]);
    EXPECT_NEAR(hit.distance, 19, 1e-6);
    EXPECT_TRUE(Await([&](const std::vector<Body>& b) { return Has(b, ids[0]); }));
    int64_t removed = 0;
    s = client_->Remove(ids, &removed);
    ASSERT_TRUE(s.ok()) << s.message;
    EXPECT_EQ(removed, 1);
    EXPECT_TRUE(Await([&](const std::vector<Body>& b) { return !Has(b, ids[0]); })) << "a ghost";
  }

 private:
  static bool Has(const std::vector<Body>& bodies, uint64_t id) {
    return std::any_of(bodies.begin(), bodies.end(), [id](const Body& b) { return b.id == id; });
  }
  bool Await(const std::function<bool(const std::vector<Body>&)>& condition) {
    std::vector<Body> bodies;
    for (const auto end = std::chrono::steady_clock::now() + 10s; std::chrono::steady_clock::now() < end;) {
      client_->Latest(&bodies);
      if (condition(bodies)) return true;
      std::this_thread::sleep_for(5ms);
    }
    return false;
  }

  void Play() {
    std::vector<Body> bodies;
    int64_t tick = 0, last = 0;
    while (!ended_) {
      client_->Latest(&bodies, &tick);
      fewest_ = std::min(fewest_, bodies.size());
      most_ = std::max(most_, bodies.size());
      backwards_ += tick < std::exchange(last, tick) ? 1 : 0;
      Push push;
      push.body = static_cast<uint64_t>(1 + pushes_ % kBodies);
      push.kind = Push::Kind::kVelocityChange;
      push.linear.y = kPush;
      expected_[push.body - 1] += kPush;
      client_->Do(push);
      ++pushes_;
      std::this_thread::sleep_for(4ms);
    }
  }
  void Stop() {
    ended_ = true;
    thread_.join();
  }

  std::unique_ptr<Client> client_;
  std::atomic<bool> ended_ = false;
  // Of the thread, until it has ended.
  std::vector<double> expected_;  // m/s, by body
  int64_t pushes_ = 0, backwards_ = 0;
  size_t fewest_ = kBodies, most_ = kBodies;
  std::thread thread_;
};

TEST(ClientLayouts, AClientFollowsFromTwoToSixToThreeServersUntilNoneOfTheFirstIsLeft) {
  ChangingWorld world;
  const std::set<std::string> first = world.Endpoints();
  Player player(world.status().regions[0].endpoint);
  ASSERT_TRUE(world.desk().Resize(3, 2).ok());
  world.AwaitStill();
  EXPECT_EQ(world.Endpoints().size(), 6u);
  player.ExpectServers(world.Endpoints());
  ASSERT_TRUE(world.desk().Resize(3, 1).ok());
  world.AwaitStill();
  EXPECT_EQ(world.Endpoints().size(), 3u);
  player.ExpectServers(world.Endpoints());
  for (RegionId r : {0, 1}) {
    const std::vector<RegionId> members = world.desk().state().now.members;
    if (std::count(members.begin(), members.end(), r) == 0) continue;
    ASSERT_TRUE(world.desk().Drain(r).ok());
    world.AwaitStill();
  }
  for (const std::string& endpoint : world.Endpoints()) EXPECT_FALSE(first.contains(endpoint)) << endpoint;
  player.ExpectServers(world.Endpoints());
  // Names of regions that have left are given again.
  ASSERT_TRUE(world.desk().Resize(4, 1).ok());
  world.AwaitStill();
  EXPECT_EQ(world.Endpoints().size(), 4u);
  player.ExpectServers(world.Endpoints());
  player.ExpectAllWasWell();
  EXPECT_EQ(player.backwards(), 0);
  player.ExpectSpawnRayAndRemove();
}

TEST(ClientLayouts, AClientFollowsServersThatDieAndComeBackElsewhere) {
  ChangingWorld world(40);
  const std::set<std::string> first = world.Endpoints();
  Player player(world.status().regions[0].endpoint);
  world.Replace(0);
  player.ExpectServers(world.Endpoints());
  ASSERT_TRUE(world.desk().Resize(3, 1).ok());
  world.Replace(1);
  world.AwaitStill();
  for (const std::string& endpoint : world.Endpoints()) EXPECT_FALSE(first.contains(endpoint)) << endpoint;
  player.ExpectServers(world.Endpoints());
  player.ExpectAllWasWell();
  player.ExpectSpawnRayAndRemove();
}

}  // namespace
}  // namespace aureole
