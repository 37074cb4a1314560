// A world whose layout changes while it runs, on hosted regions over real links: servers join and leave, die and come
// back, and every body is where the undivided world has it.
#include <gtest/gtest.h>

#include <grpcpp/grpcpp.h>

#include <condition_variable>
#include <filesystem>
#include <map>
#include <mutex>
#include <optional>

#include "server/control/world_file.h"
#include "server/core/division.h"
#include "server/region/hosted_region.h"
#include "server/transport/input_codec.h"

namespace aureole {
namespace {

namespace fs = std::filesystem;

constexpr double kInf = std::numeric_limits<double>::infinity();
constexpr std::chrono::seconds kPatience(60);

// Columns between these edges for these regions, in order; the others have no area.
LayoutChange ColumnsFor(uint64_t epoch, int regions, const std::vector<RegionId>& owners,
                        const std::vector<double>& edges, const std::vector<RegionId>& members) {
  LayoutChange out;
  out.epoch = epoch;
  out.regions.resize(static_cast<size_t>(regions));
  for (size_t i = 0; i < owners.size(); ++i) {
    out.regions[static_cast<size_t>(owners[i])] = {i == 0 ? -kInf : edges[i - 1], i == edges.size() ? kInf : edges[i],
                                                   -kInf, kInf};
  }
  for (int r = 0; r < regions; ++r) out.ranks.push_back(r);
  out.members = members;
  return out;
}

// Servers of one world, and as much of a control plane as a change of the layout needs.
class Servers {
 public:
  struct Outcome {
    Tick tick = 0;
    std::string refused;
  };

  // `checkpoint_every`: 0: none.
  Servers(v1::WorldSpec spec, bool undivided, Tick checkpoint_every)
      : spec_(std::move(spec)), undivided_(undivided), checkpoint_every_(checkpoint_every) {
    std::string name = (fs::temp_directory_path() / "hosted-layouts-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
  }
  ~Servers() {
    for (auto& [r, node] : nodes_) Down(node.get());
    nodes_.clear();
    fs::remove_all(directory_);
  }

  // The first servers of the world.
  void Begin(int regions, Tick last_tick = 0) {
    last_tick_ = last_tick;
    for (RegionId r = 0; r < regions; ++r) Listen(r);
    for (RegionId r = 0; r < regions; ++r) Load(r, false, nullptr);
    for (RegionId r = 0; r < regions; ++r) Start(r);
  }

  // A server for a region that joins with this change; it has met all others.
  void Join(RegionId r, const LayoutChange& change) {
    Listen(r);
    Load(r, false, &change);
    TellMoved(r, change.epoch);
    Start(r);
    EXPECT_TRUE(Await([&] { return nodes_.at(r)->met; })) << "region " << r << " has not met all others";
  }

  // Offers the change to this region.
  void Offer(RegionId to, const LayoutChange& change, uint64_t sequence) {
    v1::ChangeLayout message;
    message.set_sequence(sequence);
    EncodeLayoutChange(change, message.mutable_layout());
    const absl::Status s = nodes_.at(to)->hosted->ChangeLayout(message);
    EXPECT_TRUE(s.ok()) << s;
  }
  Outcome AwaitOutcome(uint64_t sequence) {
    EXPECT_TRUE(Await([&] { return outcomes_.contains(sequence); }));
    const std::lock_guard lock(mutex_);
    return outcomes_[sequence];
  }
  // Until all who have not left report this epoch.
  void AwaitEpoch(uint64_t epoch) {
    EXPECT_TRUE(Await([&] {
      return std::all_of(nodes_.begin(), nodes_.end(),
                         [&](const auto& n) { return n.second->left || n.second->epoch >= epoch; });
    }));
  }
  // Until the region has left, and its server would end.
  void AwaitGone(RegionId r) {
    EXPECT_TRUE(Await([&] { return nodes_.at(r)->gone; })) << "region " << r;
    Down(nodes_.at(r).get());
    nodes_.erase(r);
    v1::PeerLeft left;
    left.set_region(r);
    for (auto& [other, node] : nodes_) node->hosted->PeerLeft(left);
  }
  void AwaitBodies(RegionId r, bool any) {
    EXPECT_TRUE(Await([&] { return (nodes_.at(r)->bodies > 0) == any; })) << "region " << r;
  }
  // Until all have stepped so many ticks more than the slowest has now.
  void RunFor(Tick ticks) {
    Tick from = 0;
    {
      const std::lock_guard lock(mutex_);
      from = MinTick();
    }
    EXPECT_TRUE(Await([&] { return MinTick() >= from + ticks; }));
  }
  void AwaitEnd() {
    EXPECT_TRUE(Await([&] { return MinTick() >= last_tick_; }));
  }

  // The server dies, and the next incarnation takes over. `joins`: with which it would join, had it not.
  void Replace(RegionId r, const LayoutChange* joins = nullptr) {
    Down(nodes_.at(r).get());
    Listen(r);
    Load(r, true, joins);
    TellMoved(r, joins != nullptr ? joins->epoch : 0);
    Start(r);
  }

  // Sums of hashes, and bodies, of the ticks that all have reported.
  std::map<Tick, std::pair<uint64_t, int64_t>> Hashes() {
    const std::lock_guard lock(mutex_);
    std::map<Tick, std::pair<uint64_t, int64_t>> out;
    for (const auto& [key, hash] : hashes_) {
      if (key.first > MinTick()) break;
      out[key.first].first += hash.first;
      out[key.first].second += hash.second;
    }
    return out;
  }
  int64_t violations() {
    const std::lock_guard lock(mutex_);
    return violations_;
  }
  int64_t refused() {
    const std::lock_guard lock(mutex_);
    return refused_;
  }
  std::vector<RegionId> there() const {
    std::vector<RegionId> out;
    for (const auto& [r, node] : nodes_) out.push_back(r);
    return out;
  }

 private:
  struct Node {
    std::unique_ptr<PeerService> service;
    std::unique_ptr<grpc::Server> server;
    std::unique_ptr<HostedRegion> hosted;
    std::string endpoint;
    uint64_t incarnation = 0;
    // Guarded by the mutex.
    bool met = false, left = false, gone = false;
    uint64_t epoch = 0;
    Tick tick = 0;
    int64_t bodies = 0;
  };

  template <class Condition>
  bool Await(Condition condition) {
    std::unique_lock lock(mutex_);
    return changed_.wait_for(lock, kPatience, condition);
  }
  // With the mutex.
  Tick MinTick() const {
    Tick least = std::numeric_limits<Tick>::max();
    for (const auto& [r, node] : nodes_) least = std::min(least, node->tick);
    return least;
  }

  void Listen(RegionId r) {
    const std::lock_guard lock(mutex_);
    std::unique_ptr<Node>& node = nodes_[r];
    if (node == nullptr) node = std::make_unique<Node>();
    node->service = std::make_unique<PeerService>();
    grpc::ServerBuilder builder;
    ConfigureServer(&builder);
    int port = 0;
    builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
    builder.RegisterService(node->service.get());
    node->server = builder.BuildAndStart();
    node->endpoint = "127.0.0.1:" + std::to_string(port);
    node->incarnation = ++incarnations_[r];
    node->met = node->left = node->gone = false;
  }

  void Load(RegionId r, bool recover, const LayoutChange* joins) {
    v1::Assignment a;
    a.set_region(r);
    *a.mutable_world() = spec_;
    a.set_layout_epoch(1);
    const RegionId last = joins != nullptr ? static_cast<RegionId>(joins->regions.size()) : nodes_.rbegin()->first + 1;
    for (RegionId i = 0; i < last; ++i) {
      a.add_endpoints(nodes_.contains(i) ? nodes_.at(i)->endpoint : "");
      a.add_incarnations(nodes_.contains(i) ? nodes_.at(i)->incarnation : 0);
    }
    a.set_incarnation(nodes_.at(r)->incarnation);
    a.set_undivided(undivided_);
    a.set_no_real_time(undivided_);
    a.set_last_tick(last_tick_);
    a.set_hash_every(5);
    a.set_checkpoint_every(checkpoint_every_);
    a.set_recover(recover);
    if (joins != nullptr) EncodeLayoutChange(*joins, a.mutable_join());
    absl::StatusOr<std::unique_ptr<HostedRegion>> hosted =
        HostedRegion::Load(a, directory_ / ("region-" + std::to_string(r)), grpc::InsecureChannelCredentials());
    ASSERT_TRUE(hosted.ok()) << hosted.status();
    nodes_.at(r)->hosted = *std::move(hosted);
    nodes_.at(r)->hosted->Connect(nodes_.at(r)->service.get(), grpc::InsecureChannelCredentials());
  }

  void TellMoved(RegionId r, uint64_t joins) {
    v1::PeerMoved moved;
    moved.set_region(r);
    moved.set_endpoint(nodes_.at(r)->endpoint);
    moved.set_incarnation(nodes_.at(r)->incarnation);
    moved.set_joins(joins);
    for (auto& [other, node] : nodes_) {
      if (other != r) node->hosted->PeerMoved(moved);
    }
  }

  void Start(RegionId r) {
    Node* const node = nodes_.at(r).get();
    if (start_us_ == 0) {
      start_us_ =
          std::chrono::duration_cast<std::chrono::microseconds>(std::chrono::system_clock::now().time_since_epoch())
              .count();
    }
    TickLoop::Hooks hooks;
    hooks.inputs = [] { return std::vector<Input>(); };
    hooks.outcomes = [this](const std::vector<InputOutcome>& outcomes) {
      const std::lock_guard lock(mutex_);
      for (const InputOutcome& o : outcomes) outcomes_[o.name.second] = {o.tick, o.refused};
      changed_.notify_all();
    };
    hooks.after_tick = [](const FrameSample&) {};
    hooks.publish = [](Region*, int64_t, const std::vector<Input>&) {};
    hooks.report = [this, r, node](const v1::Report& report) {
      const std::lock_guard lock(mutex_);
      for (const v1::TickHash& h : report.hashes()) {
        const auto [it, fresh] = hashes_.emplace(std::pair(h.tick(), r), std::pair(h.hash(), h.bodies()));
        // An incarnation says again what the one before it has said.
        EXPECT_EQ(it->second, std::pair(h.hash(), h.bodies())) << "tick " << h.tick() << ", region " << r;
      }
      node->met = report.may_join();
      node->left = report.left();
      node->epoch = report.layout_epoch();
      node->tick = report.tick();
      node->bodies = report.bodies();
      violations_ += report.violation_log_size();
      refused_ = std::max(refused_, report.refused_frames());
      changed_.notify_all();
      return true;
    };
    hooks.log = [](const std::string&) {};
    hooks.fenced = [] {};
    hooks.gone = [this, node] {
      const std::lock_guard lock(mutex_);
      node->gone = true;
      changed_.notify_all();
    };
    node->hosted->Start(start_us_, std::move(hooks));
  }

  // As if its process had died.
  static void Down(Node* node) {
    if (node->hosted != nullptr) node->hosted->Stop();
    node->hosted.reset();
    if (node->server != nullptr) node->server->Shutdown(std::chrono::system_clock::now());
    node->server.reset();
  }

  const v1::WorldSpec spec_;
  const bool undivided_;
  const Tick checkpoint_every_;
  Tick last_tick_ = 0;
  int64_t start_us_ = 0;
  fs::path directory_;
  std::map<RegionId, uint64_t> incarnations_;
  std::mutex mutex_;
  std::condition_variable changed_;
  std::map<RegionId, std::unique_ptr<Node>> nodes_;
  std::map<uint64_t, Outcome> outcomes_;
  std::map<std::pair<Tick, RegionId>, std::pair<uint64_t, int64_t>> hashes_;
  int64_t violations_ = 0, refused_ = 0;
};

v1::WorldSpec TwoColumns() {
  absl::StatusOr<WorldFile> file = OpenWorldFile(AUREOLE_WORLDS "/corner-storm.json");
  EXPECT_TRUE(file.ok()) << file.status();
  v1::WorldSpec spec = file->spec;
  spec.mutable_layout()->mutable_columns()->add_edges(0);
  return spec;
}

void ExpectExact(Servers* servers) {
  const auto hashes = servers->Hashes();
  ASSERT_GT(hashes.size(), 10u);
  Servers whole(TwoColumns(), true, 0);
  whole.Begin(1, hashes.rbegin()->first);
  whole.AwaitEnd();
  const auto expected = whole.Hashes();
  for (const auto& [tick, sum] : hashes) {
    ASSERT_EQ(sum.second, expected.at(tick).second) << "bodies, tick " << tick;
    ASSERT_EQ(sum.first, expected.at(tick).first) << "tick " << tick;
  }
  EXPECT_EQ(servers->violations(), 0);
  EXPECT_EQ(servers->refused(), 0);
}

const LayoutChange kThird = ColumnsFor(2, 3, {0, 1, 2}, {-2, 2}, {0, 1, 2});
const LayoutChange kWithoutArea = ColumnsFor(3, 3, {2, 0}, {0.5}, {0, 1, 2});
const LayoutChange kWithoutServer = ColumnsFor(4, 3, {2, 0}, {0.5}, {0, 2});

class HostedLayouts : public testing::TestWithParam<Tick> {};

TEST_P(HostedLayouts, AServerJoinsAndAnotherLeavesUnderLoad) {
  Servers servers(TwoColumns(), false, GetParam());
  servers.Begin(2);
  servers.RunFor(20);
  servers.Join(2, kThird);
  servers.Offer(0, kThird, 1);
  const Servers::Outcome joined = servers.AwaitOutcome(1);
  EXPECT_EQ(joined.refused, "");
  servers.AwaitEpoch(2);
  servers.AwaitBodies(2, true);
  servers.Offer(2, kWithoutArea, 2);
  EXPECT_GT(servers.AwaitOutcome(2).tick, joined.tick);
  servers.AwaitBodies(1, false);
  servers.RunFor(5);
  servers.Offer(1, kWithoutServer, 3);
  servers.AwaitGone(1);
  servers.RunFor(30);
  EXPECT_EQ(servers.there(), (std::vector<RegionId>{0, 2}));
  ExpectExact(&servers);
}

INSTANTIATE_TEST_SUITE_P(Checkpoints, HostedLayouts, testing::Values(0, 20));

TEST(HostedLayouts, ServersThatDieAroundAChangeDoItAgain) {
  Servers servers(TwoColumns(), false, 30);
  servers.Begin(2);
  servers.RunFor(20);
  servers.Join(2, kThird);
  servers.Offer(0, kThird, 1);
  servers.Replace(0);
  servers.Offer(0, kThird, 1);  // for all that is known here, the other has not heard of it
  servers.AwaitEpoch(2);
  servers.Replace(2, &kThird);
  servers.Replace(1);
  servers.RunFor(10);
  servers.AwaitBodies(2, true);
  servers.Offer(2, kWithoutArea, 2);
  EXPECT_EQ(servers.AwaitOutcome(2).refused, "");
  servers.AwaitBodies(1, false);
  servers.RunFor(5);
  servers.Offer(0, kWithoutServer, 3);
  EXPECT_EQ(servers.AwaitOutcome(3).refused, "");
  servers.Replace(1);  // while the others may still need it
  servers.Replace(0);
  servers.AwaitGone(1);
  servers.Replace(2, &kThird);
  servers.RunFor(40);
  ExpectExact(&servers);
}

TEST(HostedLayouts, ANewServerTakesTheNameOfOneThatHasLeft) {
  Servers servers(TwoColumns(), false, 20);
  servers.Begin(2);
  servers.RunFor(10);
  uint64_t sequence = 0;
  const auto change = [&](const LayoutChange& c) {
    servers.Offer(0, c, ++sequence);
    EXPECT_EQ(servers.AwaitOutcome(sequence).refused, "");
    servers.AwaitEpoch(c.epoch);
  };
  for (uint64_t epoch = 2; epoch < 8; epoch += 3) {
    change(ColumnsFor(epoch, 2, {0}, {}, {0, 1}));
    servers.AwaitBodies(1, false);
    servers.RunFor(3);
    change(ColumnsFor(epoch + 1, 2, {0}, {}, {0}));
    servers.AwaitGone(1);
    const LayoutChange again = ColumnsFor(epoch + 2, 2, {1, 0}, {0.3}, {0, 1});
    servers.Join(1, again);
    change(again);
    servers.AwaitBodies(1, true);
    servers.Replace(1, &again);
    servers.RunFor(10);
    servers.Replace(0);
  }
  servers.RunFor(20);
  ExpectExact(&servers);
}

}  // namespace
}  // namespace aureole
