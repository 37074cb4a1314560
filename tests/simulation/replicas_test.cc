// What clients are told of seeded split worlds, over slow and fast streams: the merged world is the world, after every
// frame, and nothing flickers while bodies change their servers.
#include <gtest/gtest.h>

#include <chrono>
#include <condition_variable>
#include <map>
#include <memory>
#include <numeric>
#include <set>
#include <thread>

#include "client/src/replica_decoder.h"
#include "client/src/replica_merger.h"
#include "server/core/toy_engine.h"
#include "server/physics/bullet_engine.h"
#include "server/transport/replica_publisher.h"
#include "server/transport/world_spec.h"
#include "tests/simulation/lockstep.h"
#include "tests/simulation/random.h"
#include "tests/simulation/scenario.h"

namespace aureole {
namespace {

using client::LostBody;
using client::MergedBody;
using client::ReplicaDecoder;
using client::ReplicaMerger;
using client::ToldBody;

// Takes frames while it is not busy.
class Reader final : public ReplicaSubscriber {
 public:
  explicit Reader(ReplicaRequest request) : request_(std::make_shared<const ReplicaRequest>(std::move(request))) {}

  State Poll() override {
    const std::lock_guard lock(mutex_);
    return gone_ ? State::kGone : busy_ ? State::kBusy : State::kReady;
  }
  bool Send(const grpc::Slice& frame, Tick) override {
    const std::lock_guard lock(mutex_);
    v1::ReplicaFrame& parsed = frames_.emplace_back();
    EXPECT_TRUE(parsed.ParseFromArray(frame.begin(), static_cast<int>(frame.size())));
    bytes_ += static_cast<int64_t>(frame.size());
    return true;
  }
  std::shared_ptr<const ReplicaRequest> TakeRequest() override {
    const std::lock_guard lock(mutex_);
    return std::exchange(request_, nullptr);
  }
  void End(const grpc::Status&) override {
    const std::lock_guard lock(mutex_);
    gone_ = true;
  }

  void SetBusy(bool busy) {
    const std::lock_guard lock(mutex_);
    busy_ = busy;
  }
  void Want(ReplicaRequest request) {
    const std::lock_guard lock(mutex_);
    request_ = std::make_shared<const ReplicaRequest>(std::move(request));
  }
  std::vector<v1::ReplicaFrame> TakeFrames() {
    const std::lock_guard lock(mutex_);
    return std::exchange(frames_, {});
  }
  int64_t bytes() {
    const std::lock_guard lock(mutex_);
    return bytes_;
  }

 private:
  std::mutex mutex_;
  std::shared_ptr<const ReplicaRequest> request_;
  std::vector<v1::ReplicaFrame> frames_;
  int64_t bytes_ = 0;
  bool busy_ = false, gone_ = false;
};

ReplicaRequest Read(const v1::StreamReplicasRequest& message, int64_t tick_us) {
  SpecCheck check;
  ReplicaRequest out = ReplicaRequest::Read(Path(), message, tick_us, &check);
  EXPECT_TRUE(check.ok()) << check.status();
  return out;
}

// One client that watches every region of a world in lock-step.
class Watched {
 public:
  Watched(World world, const v1::StreamReplicasRequest& request,
          std::unique_ptr<Engine> (*make)(const Environment&) = MakeToyEngine)
      : split_(std::move(world), make) {
    const int n = split_.world().layout.size();
    for (RegionId r = 0; r < n; ++r) {
      publishers_.push_back(std::make_unique<ReplicaPublisher>());
      publishers_.back()->Serve(r, 1, tick_us());
      readers_.push_back(std::make_shared<Reader>(Read(request, tick_us())));
      publishers_.back()->Join(readers_.back());
      decoders_.emplace_back(request.precision(), request.velocities());
      while (publishers_.back()->subscribers() == 0) std::this_thread::yield();
    }
    history_.resize(static_cast<size_t>(n));
    std::vector<RegionId> all(static_cast<size_t>(n));
    std::iota(all.begin(), all.end(), 0);
    merger_.Follow(1, all);
  }

  // Steps all regions to tick n, and publishes its state.
  void Step(Tick n) {
    split_.RunTo(n);
    for (RegionId r = 0; r < regions(); ++r) {
      Region& region = split_.region(r);
      auto& state = history_[static_cast<size_t>(r)][n];
      for (BodyId id : region.engine().Ids()) state[id] = region.engine().Pose(id);
      publishers_[static_cast<size_t>(r)]->AfterTick(&region);
    }
    for (auto& p : publishers_) {
      while (p->published() < n) std::this_thread::yield();
    }
  }

  // Takes one region's frames. Bodies that the merged world loses are appended.
  void Take(RegionId r, std::vector<LostBody>* lost) {
    for (const v1::ReplicaFrame& frame : readers_[static_cast<size_t>(r)]->TakeFrames()) {
      std::string error;
      ASSERT_TRUE(decoder(r).Apply(frame, &error)) << error;
      for (const v1::BodyDescription& d : frame.described()) {
        uint64_t id = 0;
        for (uint64_t step : d.body()) described_.insert(id += step);
      }
      merger_.Apply(r, decoder(r), frame);
      lost->insert(lost->end(), merger_.lost().begin(), merger_.lost().end());
    }
  }

  // What the region owned in the state that its stream is at.
  const std::map<BodyId, BodyPose>& Truth(RegionId r) { return history_[static_cast<size_t>(r)][decoder(r).tick()]; }

  int regions() const { return split_.world().layout.size(); }
  int64_t tick_us() const { return split_.world().environment.tick_us; }
  ReplicaDecoder& decoder(RegionId r) { return decoders_[static_cast<size_t>(r)]; }
  Reader& reader(RegionId r) { return *readers_[static_cast<size_t>(r)]; }
  ReplicaPublisher& publisher(RegionId r) { return *publishers_[static_cast<size_t>(r)]; }
  const ReplicaMerger& merger() const { return merger_; }
  const std::set<uint64_t>& described() const { return described_; }
  sim::Lockstep& split() { return split_; }

 private:
  sim::Lockstep split_;
  std::vector<std::unique_ptr<ReplicaPublisher>> publishers_;
  std::vector<std::shared_ptr<Reader>> readers_;
  std::vector<ReplicaDecoder> decoders_;
  std::vector<std::map<Tick, std::map<BodyId, BodyPose>>> history_;
  ReplicaMerger merger_;
  std::set<uint64_t> described_;
};

double Off(const ToldBody& told, const BodyPose& truth) {
  return (Vec3(told.position[0], told.position[1], told.position[2]) - truth.position).norm();
}

double VelocityOff(const ToldBody& told, const BodyPose& truth) {
  return (Vec3(told.velocity[0], told.velocity[1], told.velocity[2]) - truth.velocity).cwiseAbs().maxCoeff();
}

// In degrees.
double Turned(const ToldBody& told, const BodyPose& truth) {
  const auto& q = told.orientation;
  return truth.orientation.angularDistance(Quat(q[3], q[0], q[1], q[2])) * 180 / 3.14159265358979323846;
}

// Every body of the region, each once, as it was.
void ExpectSameState(Watched* w, RegionId r, const v1::StreamReplicasRequest& request) {
  static constexpr double kMetres[] = {0.5e-3, 7e-3, 0}, kDegrees[] = {0.05, 0.4, 1e-5},
                          kSpeed[] = {1.0 / 128, 1.0 / 16, 0};
  const auto& truth = w->Truth(r);
  ReplicaDecoder& decoder = w->decoder(r);
  ASSERT_EQ(decoder.bodies(), truth.size()) << "region " << r << ", tick " << decoder.tick();
  for (const auto& [id, pose] : truth) {
    ASSERT_TRUE(decoder.Contains(id)) << "body " << id << ", region " << r << ", tick " << decoder.tick();
    const ToldBody told = decoder.Get(id);
    ASSERT_LE(Off(told, pose), kMetres[request.precision()]) << "body " << id << ", tick " << decoder.tick();
    if (request.velocities() || request.precision() == v1::EXACT) {
      ASSERT_LE(VelocityOff(told, pose), kSpeed[request.precision()]) << id;
    }
    ASSERT_LE(Turned(told, pose), kDegrees[request.precision()]) << "body " << id << ", tick " << decoder.tick();
    ASSERT_EQ(told.asleep, pose.asleep) << id;
    ASSERT_TRUE(w->described().contains(id)) << id;
  }
}

void RunSeed(uint64_t seed, int64_t* transfers) {
  sim::ScenarioOptions options;
  sim::Scenario scenario = sim::MakeScenario(seed, options, MakeToyEngine);
  sim::Random rng(seed);
  v1::StreamReplicasRequest request;
  request.set_rate(1000);
  request.set_precision(static_cast<v1::Precision>(seed % 3));
  request.set_velocities(seed % 2 == 0);
  if (request.precision() != v1::EXACT && seed / 3 % 2 == 0) request.set_encoding(v1::BITS);
  const double slow = seed % 4 == 3 ? 0 : 0.3;  // share of ticks in which a reader is busy
  const double late = seed % 5 < 2 ? 0.3 : 0;   // share of ticks in which a stream's frames are read later
  Watched w(scenario.world, request);
  std::vector<LostBody> lost;
  std::set<uint64_t> gone;  // for ever: ids are not used again
  std::map<uint64_t, uint32_t> epochs;
  for (Tick n = 1; n <= scenario.ticks; ++n) {
    for (RegionId r = 0; r < w.regions(); ++r) w.reader(r).SetBusy(rng.Chance(slow));
    w.Step(n);
    std::vector<RegionId> order;
    for (RegionId r = 0; r < w.regions(); ++r) order.push_back(r);
    for (size_t i = order.size(); i > 1; --i)
      std::swap(order[i - 1], order[static_cast<size_t>(rng.Below(static_cast<int>(i)))]);
    for (RegionId r : order) {
      if (rng.Chance(late)) continue;
      lost.clear();
      ASSERT_NO_FATAL_FAILURE(w.Take(r, &lost));
      if (w.decoder(r).tick() == 0) continue;
      ASSERT_NO_FATAL_FAILURE(ExpectSameState(&w, r, request));
      for (const LostBody& l : lost) {
        gone.insert(l.body);
        ASSERT_EQ(w.split().Owner(l.body), kNoRegion)
            << "body " << l.body << " flickers at tick " << n << " after a frame of region " << r;
      }
    }
    for (const auto& [id, body] : w.merger().bodies()) {
      ASSERT_FALSE(gone.contains(id)) << "body " << id << " was lost and is back at tick " << n;
      ASSERT_GE(body.state.epoch, epochs[id]) << "body " << id << " is back at a former server at tick " << n;
      epochs[id] = body.state.epoch;
    }
    if (slow > 0 || late > 0) continue;
    // All frames are of this tick: every body that is somewhere is shown, as its owner tells it.
    for (RegionId r = 0; r < w.regions(); ++r) {
      for (const auto& [id, pose] : w.Truth(r)) {
        const auto it = w.merger().bodies().find(id);
        ASSERT_NE(it, w.merger().bodies().end()) << "body " << id << " is missing at tick " << n;
        ASSERT_EQ(it->second.region, r) << "body " << id << ", tick " << n;
      }
    }
  }
  for (RegionId r = 0; r < w.regions(); ++r) *transfers += w.split().region(r).stats().bodies_out;
}

TEST(Replicas, MergedStreamsShowTheWorldAfterEveryFrame) {
  int64_t transfers = 0;
  for (uint64_t seed = 1; seed <= 60; ++seed) {
    SCOPED_TRACE(seed);
    ASSERT_NO_FATAL_FAILURE(RunSeed(seed, &transfers));
  }
  EXPECT_GT(transfers, 2000) << "an easy world proves little";
}

BodySpec Ball(BodyId id, const Vec3& position, const Vec3& velocity) {
  auto shape = std::make_shared<Shape>();
  shape->radius = 0.3;
  BodySpec b;
  b.id = id;
  b.shape = shape;
  b.position = position;
  b.velocity = velocity;
  return b;
}

World OneRegion() {
  World w(*Layout::Columns({}));
  w.environment.gravity = Vec3::Zero();
  return w;
}

v1::StreamReplicasRequest EveryTick() {
  v1::StreamReplicasRequest request;
  request.set_rate(1000);
  return request;
}

// Bodies of the real engine, which turn, fall asleep and wake up, in every precision and encoding.
TEST(Replicas, TurningBodiesAreToldWithinTheBounds) {
  for (int kind = 0; kind < 10; ++kind) {
    SCOPED_TRACE(kind);
    const absl::StatusOr<World> world = LoadWorldFile(AUREOLE_WORLDS "/demo.json");
    ASSERT_TRUE(world.ok()) << world.status();
    v1::StreamReplicasRequest request;
    request.set_rate(31);
    request.set_precision(kind < 4 ? v1::FINE : kind < 8 ? v1::COARSE : v1::EXACT);
    request.set_velocities(kind % 2 == 1);
    if (kind < 8 && kind % 4 >= 2) request.set_encoding(v1::BITS);
    Watched w(*world, request, MakeBulletEngine);
    std::vector<LostBody> lost;
    for (Tick n = 2; n <= 300; n += 2) {
      w.Step(n);
      for (RegionId r = 0; r < w.regions(); ++r) {
        ASSERT_NO_FATAL_FAILURE(w.Take(r, &lost));
        ASSERT_NO_FATAL_FAILURE(ExpectSameState(&w, r, request));
      }
    }
  }
}

TEST(Replicas, BodiesAtRestCostNothing) {
  World world = OneRegion();
  for (BodyId id = 1; id <= 100; ++id) {
    world.bodies.push_back(Ball(id, {static_cast<double>(id), 0, 0}, Vec3::Zero()));
    world.bodies.back().asleep = true;
  }
  Watched w(world, EveryTick());
  w.Step(1);
  w.Step(2);
  const int64_t before = w.reader(0).bytes();
  EXPECT_GT(before, 100 * 10);
  for (Tick n = 3; n <= 102; ++n) w.Step(n);
  EXPECT_LE(w.reader(0).bytes() - before, 100 * 20) << "100 frames of a head and nothing else";
}

TEST(Replicas, ViewHoldsWhatIsInItsCellsAndForgetsWhatLeaves) {
  World world = OneRegion();
  for (BodyId id = 1; id <= 20; ++id) {  // through the view, one after the other
    world.bodies.push_back(Ball(id, {-10.0 * static_cast<double>(id), 0, static_cast<double>(id)}, {25, 0, 0}));
  }
  v1::StreamReplicasRequest request = EveryTick();
  request.mutable_view()->mutable_box()->mutable_min()->set_x(1);
  request.mutable_view()->mutable_box()->mutable_max()->set_x(31);
  request.mutable_view()->mutable_box()->mutable_max()->set_z(31);
  Watched w(world, request);
  std::vector<LostBody> lost;
  size_t most = 0;
  for (Tick n = 1; n <= 700; ++n) {
    w.Step(n);
    w.Take(0, &lost);
    std::set<BodyId> inside;
    for (const auto& [id, pose] : w.Truth(0)) {
      if (CellOf(pose.position) == CellKey{0, 0}) inside.insert(id);
    }
    ASSERT_EQ(w.decoder(0).bodies(), inside.size()) << n;
    for (BodyId id : inside) ASSERT_TRUE(w.decoder(0).Contains(id)) << n;
    most = std::max(most, inside.size());
  }
  EXPECT_EQ(lost.size(), 20u);
  for (const LostBody& l : lost) EXPECT_EQ(l.why, LostBody::Why::kOutOfView);
  EXPECT_GE(most, 2u);
}

TEST(Replicas, ViewThatMovesDropsCellsAndShowsOthers) {
  World world = OneRegion();
  for (BodyId id = 1; id <= 40; ++id) {
    world.bodies.push_back(Ball(id, {8.0 * static_cast<double>(id), 0, 0}, Vec3::Zero()));
    world.bodies.back().asleep = id % 2 == 0;
  }
  const auto around = [](double x) {
    v1::StreamReplicasRequest request = EveryTick();
    request.mutable_view()->mutable_sphere()->mutable_centre()->set_x(x);
    request.mutable_view()->mutable_sphere()->set_radius(20);
    return request;
  };
  Watched w(world, around(50));
  std::vector<LostBody> lost;
  for (Tick n = 1; n <= 60; ++n) {
    const double x = 50 + 3.0 * static_cast<double>(n);
    w.reader(0).Want(Read(around(x), w.tick_us()));
    w.publisher(0).Wake();
    w.Step(2 * n - 1);
    w.Step(2 * n);  // the wish is known by now, so this is of the new view
    w.Take(0, &lost);
    const CellView view = Read(around(x), w.tick_us()).view;
    for (const auto& [id, pose] : w.Truth(0)) {
      ASSERT_EQ(w.decoder(0).Contains(id), view.Selects(CellOf(pose.position))) << "body " << id << ", view at " << x;
    }
  }
  EXPECT_GT(lost.size(), 10u);
}

TEST(Replicas, WhatCrossesBetweenNearAndFarCellsIsNeverLostOrDoubled) {
  World world = OneRegion();
  sim::Random rng(7);
  for (BodyId id = 1; id <= 200; ++id) {
    world.bodies.push_back(Ball(id, {rng.In(-300, 300), 3.0 * static_cast<double>(id), rng.In(-300, 300)},
                                {rng.In(-30, 30), 0, rng.In(-30, 30)}));
  }
  v1::StreamReplicasRequest request = EveryTick();
  request.mutable_level_of_detail()->set_full_within(40);
  Watched w(world, request);
  std::vector<LostBody> lost;
  int64_t late = 0;
  for (Tick n = 1; n <= 300; ++n) {
    w.reader(0).SetBusy(rng.Chance(0.2));
    w.Step(n);
    w.Take(0, &lost);
    if (w.decoder(0).tick() != n) continue;
    ASSERT_EQ(w.decoder(0).bodies(), 200u) << n;
    for (const auto& [id, pose] : w.Truth(0)) {
      const double off = Off(w.decoder(0).Get(id), pose);
      ASSERT_LT(off, 8 * 0.016 * 45) << "at most 8 frames old";
      const double far = std::hypot(pose.position.x(), pose.position.z());
      if (far < 40) {
        ASSERT_LT(off, 0.5e-3) << "near the eye it is of this tick";
      }
      late += off > 0.5e-3;
    }
  }
  EXPECT_TRUE(lost.empty());
  EXPECT_GT(late, 10000) << "far bodies come less often";
}

TEST(Replicas, WhatChangesServersFarFromTheEyeIsNeverLost) {
  World world(*Layout::Columns(std::vector<double>{-100, 0, 100}));
  world.environment.gravity = Vec3::Zero();
  sim::Random rng(9);
  for (BodyId id = 1; id <= 100; ++id) {
    world.bodies.push_back(
        Ball(id, {rng.In(-200, 200), 3.0 * static_cast<double>(id), rng.In(-50, 50)}, {rng.In(-30, 30), 0, 0}));
  }
  v1::StreamReplicasRequest request = EveryTick();
  request.mutable_level_of_detail()->mutable_eye()->set_z(2000);
  request.mutable_level_of_detail()->set_full_within(10);
  Watched w(world, request);
  std::vector<LostBody> lost;
  for (Tick n = 1; n <= 400; ++n) {
    w.Step(n);
    for (RegionId r = 0; r < w.regions(); ++r) w.Take(r, &lost);
    ASSERT_TRUE(lost.empty()) << "body " << lost[0].body << " at tick " << n;
    ASSERT_EQ(w.merger().bodies().size(), 100u) << n;
  }
  EXPECT_GT(w.split().BodiesMoved(), 50);
}

// Thousands of bodies over three borders, every frame of every server read: none is ever missing, doubled or flickers.
TEST(Replicas, FiveThousandBodiesChangeServersTenThousandTimesAndNobodySees) {
  World world(*Layout::Columns(std::vector<double>{-40, 0, 40}));
  world.environment.gravity = Vec3::Zero();
  constexpr int kBodies = 5000;
  sim::Random rng(11);
  for (BodyId id = 1; id <= kBodies; ++id) {  // in lanes
    const double speed = rng.In(15, 30) * (rng.Chance(0.5) ? 1 : -1);
    const double way = speed > 0 ? -1 : 1;
    world.bodies.push_back(
        Ball(id, {way * rng.In(30, 90), 3.0 * static_cast<double>(id / 70), 3.0 * (id % 70)}, {speed, 0, 0}));
  }
  const v1::StreamReplicasRequest request = EveryTick();
  Watched w(world, request);
  std::vector<LostBody> lost;
  for (Tick n = 1; w.split().BodiesMoved() < 10'000; ++n) {
    ASSERT_LT(n, 1000) << "few change servers: " << w.split().BodiesMoved();
    w.Step(n);
    for (RegionId r = 0; r < w.regions(); ++r) {
      ASSERT_NO_FATAL_FAILURE(w.Take(r, &lost));
      ASSERT_NO_FATAL_FAILURE(ExpectSameState(&w, r, request));
      ASSERT_TRUE(lost.empty()) << "body " << lost[0].body << " at tick " << n << " after a frame of region " << r;
    }
    ASSERT_EQ(w.merger().bodies().size(), size_t{kBodies}) << n;
    for (RegionId r = 0; r < w.regions(); ++r) {
      for (const auto& [id, pose] : w.Truth(r)) {
        const MergedBody& merged = w.merger().bodies().at(id);
        ASSERT_EQ(merged.region, r) << "body " << id << ", tick " << n;
        ASSERT_LE(Off(merged.state, pose), 0.5e-3) << "body " << id << ", tick " << n;
      }
    }
  }
}

TEST(Replicas, SleeperThatIsStruckOutOfViewIsNoGhost) {
  World world = OneRegion();
  world.bodies.push_back(Ball(1, {31.5, 0, 16}, Vec3::Zero()));
  world.bodies.push_back(Ball(2, {16, 0, 16}, Vec3::Zero()));
  for (BodySpec& b : world.bodies) b.asleep = true;
  for (BodyId id = 3; id <= 8; ++id) {  // so few move that they are captured instead of the cells
    world.bodies.push_back(Ball(id, {1000, 0, 8.0 * static_cast<double>(id)}, {1, 0, 0}));
  }
  v1::StreamReplicasRequest request = EveryTick();
  request.mutable_view()->mutable_box()->mutable_max()->set_x(31);
  request.mutable_view()->mutable_box()->mutable_max()->set_z(31);
  Watched w(world, request);
  std::vector<LostBody> lost;
  for (Tick n = 1; n <= 10; ++n) w.Step(n);
  w.Take(0, &lost);
  EXPECT_EQ(w.decoder(0).bodies(), 2u);
  Input strike;
  strike.source = 3;
  strike.sequence = 1;
  strike.kind = Input::Kind::kVelocity;
  strike.body = 1;
  strike.linear = Vec3(60, 0, 0);
  ASSERT_TRUE(w.split().region(0).Submit(strike).ok());
  for (Tick n = 11; n <= 14; ++n) w.Step(n);
  w.Take(0, &lost);
  EXPECT_FALSE(w.decoder(0).Contains(1));
  EXPECT_TRUE(w.decoder(0).Contains(2));
}

TEST(Replicas, WhoJoinsIsToldOnlyWhatWasCapturedForIt) {
  World world = OneRegion();
  for (BodyId id = 1; id <= 40; ++id) {
    world.bodies.push_back(Ball(id, {8.0 * static_cast<double>(id), 0, 8}, Vec3::Zero()));
    world.bodies.back().asleep = true;
  }
  v1::StreamReplicasRequest one_cell = EveryTick();
  one_cell.mutable_view()->mutable_box()->mutable_max()->set_x(31);
  one_cell.mutable_view()->mutable_box()->mutable_max()->set_z(31);
  Watched w(world, one_cell);
  w.Step(1);
  int complete = 0;
  for (Tick n = 2; n <= 300; ++n) {
    v1::StreamReplicasRequest all = one_cell;
    all.mutable_view()->mutable_box()->mutable_max()->set_x(400 + static_cast<double>(n));
    const auto reader = std::make_shared<Reader>(Read(all, w.tick_us()));
    w.split().RunTo(n);
    w.publisher(0).AfterTick(&w.split().region(0));  // captured for one cell
    w.publisher(0).Join(reader);
    while (w.publisher(0).published() < n || w.publisher(0).subscribers() < 2) std::this_thread::yield();
    w.split().RunTo(++n);
    w.publisher(0).AfterTick(&w.split().region(0));
    while (w.publisher(0).published() < n) std::this_thread::yield();
    client::ReplicaDecoder decoder(v1::FINE, false);
    for (const v1::ReplicaFrame& frame : reader->TakeFrames()) {
      std::string error;
      ASSERT_TRUE(decoder.Apply(frame, &error)) << error;
      if (frame.more()) continue;
      ++complete;
      ASSERT_EQ(decoder.bodies(), 40u) << "tick " << frame.tick();
    }
    reader->End(grpc::Status::OK);
    w.publisher(0).Wake();
    while (w.publisher(0).subscribers() > 1) std::this_thread::yield();
  }
  EXPECT_GT(complete, 100);
}

TEST(Replicas, LargeWorldComesInSeveralFramesAndIsThenComplete) {
  World world = OneRegion();
  for (BodyId id = 1; id <= 60000; ++id) {
    world.bodies.push_back(
        Ball(id, {static_cast<double>(id % 300) * 3, 0, static_cast<double>(id / 300) * 3}, Vec3::Zero()));
    world.bodies.back().asleep = true;
  }
  v1::StreamReplicasRequest request = EveryTick();
  Watched w(world, request);
  int frames = 0;
  bool more = true;
  for (Tick n = 1; more && n < 20; ++n) {
    w.Step(n);
    for (const v1::ReplicaFrame& frame : w.reader(0).TakeFrames()) {
      ++frames;
      EXPECT_LT(frame.ByteSizeLong(), 4u << 20) << "gRPC's limit for a message";
      std::string error;
      ASSERT_TRUE(w.decoder(0).Apply(frame, &error)) << error;
      more = frame.more();
    }
  }
  EXPECT_GE(frames, 2);
  EXPECT_EQ(w.decoder(0).bodies(), 60000u);
}

TEST(Replicas, NobodyWatchingCostsNoCapture) {
  sim::Lockstep split(OneRegion());
  ReplicaPublisher publisher;
  publisher.Serve(0, 1, 16000);
  split.RunTo(1);
  publisher.AfterTick(&split.region(0));
  EXPECT_EQ(publisher.published(), 0);
  EXPECT_EQ(publisher.subscribers(), 0);
}

}  // namespace
}  // namespace aureole
