// Several regions in threads, over real links, are bit for bit the undivided world.
#include <gtest/gtest.h>

#include <grpcpp/grpcpp.h>

#include <map>
#include <mutex>
#include <random>
#include <thread>

#include "server/core/toy_engine.h"
#include "server/region/region_links.h"
#include "server/region/tick_loop.h"
#include "server/transport/link_limits.h"

namespace aureole {
namespace {

constexpr Tick kTicks = 600, kHashEvery = 20;

// A crowd of spheres and boxes in 16 x 16 m that meet, pile up on borders and come to rest.
World MakeWorld(Layout layout, int k) {
  World world(std::move(layout));
  world.name = "crowd";
  world.exchange.k = k;
  world.tolerances.speed = 8;
  world.environment.speed_limit = 8;
  BodySpec ground;
  ground.id = 1000;
  ground.motion = Motion::kStatic;
  auto plane = std::make_shared<Shape>();
  plane->kind = ShapeKind::kPlane;
  ground.shape = plane;
  world.environment.fixed.push_back(ground);
  std::mt19937_64 random(3);
  const auto uniform = [&](double low, double high) {
    return low + (high - low) * static_cast<double>(random() >> 11) * 0x1p-53;
  };
  auto box = std::make_shared<Shape>();
  box->kind = ShapeKind::kBox;
  box->half = {0.3, 0.2, 0.4};
  auto sphere = std::make_shared<Shape>();
  sphere->radius = 0.3;
  BodyId id = 1;
  for (int x = 0; x < 10; ++x) {
    for (int z = 0; z < 10; ++z) {
      BodySpec body;
      body.id = id++;
      body.shape = id % 2 == 0 ? std::shared_ptr<const Shape>(box) : sphere;
      body.position = {1.5 * x - 6.8, uniform(1, 6), 1.5 * z - 6.8};
      body.velocity = {uniform(-5, 5), uniform(-5, 0), uniform(-5, 5)};
      world.bodies.push_back(body);
    }
  }
  return world;
}

// Sums of hashes, and counts of bodies, by tick.
using Hashes = std::map<Tick, std::pair<uint64_t, int64_t>>;

class Cluster {
 public:
  explicit Cluster(World world) : world_(std::move(world)) {
    const int n = world_.layout.size();
    std::vector<std::string> endpoints;
    for (RegionId r = 0; r < n; ++r) {
      nodes_.push_back(std::make_unique<Node>());
      Node& node = *nodes_.back();
      grpc::ServerBuilder builder;
      ConfigureServer(&builder);
      int port = 0;
      builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
      builder.RegisterService(&node.service);
      node.server = builder.BuildAndStart();
      endpoints.push_back("127.0.0.1:" + std::to_string(port));
    }
    for (RegionId r = 0; r < n; ++r) {
      Node& node = *nodes_[r];
      node.region = std::make_unique<Region>(world_, r, MakeToyEngine(world_.environment));
      const LinkIdentity identity{kPeerProtocolVersion, 1, 1, r, 1, world_.exchange.k, world_.environment.tick_us};
      node.links = std::make_unique<RegionLinks>(identity, node.region->peers(), [](RegionId, const std::string&) {});
      node.links->Connect(&node.service, endpoints);
    }
  }

  // Runs all regions to the last tick, cutting the connections of a random one `cuts` times meanwhile.
  void Run(int cuts) {
    for (auto& node : nodes_) {
      TickLoop::Options options;
      options.real_time = false;
      options.last_tick = kTicks;
      options.hash_every = kHashEvery;
      TickLoop::Hooks hooks;
      hooks.inputs = [] { return std::vector<Input>(); };
      hooks.outcomes = [](const std::vector<InputOutcome>&) {};
      hooks.after_tick = [](const FrameSample&) {};
      hooks.publish = [this](Region* region, int64_t, const std::vector<Input>&) {
        const std::lock_guard lock(mutex_);
        progress_ = std::max(progress_, region->tick());
        changed_.notify_all();
      };
      hooks.report = [this](const v1::Report& report) {
        const std::lock_guard lock(mutex_);
        for (const v1::TickHash& h : report.hashes()) {
          hashes_[h.tick()].first += h.hash();
          hashes_[h.tick()].second += h.bodies();
        }
        if (report.finished()) {
          transfers_ += report.transfers();
          violations_ += report.violations();
          reconnects_ += report.reconnects();
          windows_ += report.windows_size();
        }
        return true;
      };
      hooks.log = [](const std::string& what) { ADD_FAILURE() << what; };
      node->loop = std::make_unique<TickLoop>(world_, node->region.get(), node->links.get(), nullptr, options, hooks);
      node->thread = std::thread([loop = node->loop.get()] { EXPECT_TRUE(loop->Run()); });
    }
    std::mt19937_64 random(5);
    for (int cut = 1; cut <= cuts; ++cut) {
      std::unique_lock lock(mutex_);
      ASSERT_TRUE(
          changed_.wait_for(lock, std::chrono::seconds(60), [&] { return progress_ >= cut * kTicks / (cuts + 1); }));
      lock.unlock();
      nodes_[random() % nodes_.size()]->links->CutAll();
    }
    for (auto& node : nodes_) node->thread.join();
  }

  const Hashes& hashes() const { return hashes_; }
  int64_t transfers() const { return transfers_; }
  int64_t violations() const { return violations_; }
  int64_t reconnects() const { return reconnects_; }
  int64_t windows() const { return windows_; }

 private:
  struct Node {
    ~Node() {
      if (links != nullptr) links->Close();
      server->Shutdown(std::chrono::system_clock::now() + std::chrono::seconds(1));
    }
    PeerService service;
    std::unique_ptr<grpc::Server> server;
    std::unique_ptr<Region> region;
    std::unique_ptr<RegionLinks> links;
    std::unique_ptr<TickLoop> loop;
    std::thread thread;
  };

  const World world_;
  std::vector<std::unique_ptr<Node>> nodes_;
  std::mutex mutex_;
  std::condition_variable changed_;
  Tick progress_ = 0;
  Hashes hashes_;
  int64_t transfers_ = 0, violations_ = 0, reconnects_ = 0, windows_ = 0;
};

Hashes Undivided(int k) {
  Cluster cluster(MakeWorld(*Layout::Columns({}), k));
  cluster.Run(0);
  EXPECT_EQ(cluster.hashes().size(), static_cast<size_t>(kTicks / kHashEvery));
  return cluster.hashes();
}

Layout TwoByTwo() {
  const double edge[] = {0.0};
  return *Layout::Grid(edge, edge);
}

TEST(RegionsOverLinks, SynchronousExchangeEqualsTheUndividedWorld) {
  const Hashes reference = Undivided(0);
  Cluster cluster(MakeWorld(TwoByTwo(), 0));
  cluster.Run(0);
  EXPECT_EQ(cluster.hashes(), reference);
  EXPECT_GT(cluster.transfers(), 20);
  EXPECT_EQ(cluster.violations(), 0);
  EXPECT_EQ(cluster.reconnects(), 0);
  EXPECT_EQ(cluster.windows(), 4 * 1);  // 9.6 s: the second window ends with the run
}

TEST(RegionsOverLinks, CutConnectionsChangeNoBit) {
  const Hashes reference = Undivided(0);
  Cluster cluster(MakeWorld(TwoByTwo(), 0));
  cluster.Run(25);
  EXPECT_EQ(cluster.hashes(), reference);
  EXPECT_GE(cluster.reconnects(), 25);
}

TEST(RegionsOverLinks, DelayedExchangeEqualsTheUndividedWorld) {
  const Hashes reference = Undivided(1);
  Cluster cluster(MakeWorld(TwoByTwo(), 1));
  cluster.Run(10);
  EXPECT_EQ(cluster.hashes(), reference);
  EXPECT_EQ(cluster.violations(), 0);
}

}  // namespace
}  // namespace aureole
