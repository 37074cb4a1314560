#include "tests/bench/view_cost.h"

#include <time.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <memory>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

#include "aureole/v1/simulation.pb.h"
#include "client/src/replica_decoder.h"
#include "server/core/region.h"
#include "server/physics/bullet_engine.h"
#include "server/transport/replica_publisher.h"
#include "tests/bench/quantile.h"

namespace aureole {
namespace {

constexpr double kSpacing = 4;  // m: 64 bodies in a cell
constexpr int kViewSide = 32;   // bodies: 128 m, four cells
constexpr int kDistinct = 10;   // views of their own

// A flat grid that drifts: everything is awake, and nothing leaves its cell while it is measured.
World Drifting(int side) {
  World world(Layout::Columns({}).value());
  world.environment.gravity = Vec3::Zero();
  world.environment.sleep_linear = world.environment.sleep_angular = 0;
  auto ball = std::make_shared<Shape>();
  ball->radius = 0.5;
  for (int x = 0; x < side; ++x) {
    for (int z = 0; z < side; ++z) {
      BodySpec b;
      b.id = world.bodies.size() + 1;
      b.shape = ball;
      b.material.angular_damping = 0;
      b.position = Vec3(x + 0.5, 0, z + 0.5) * kSpacing;
      b.velocity = Vec3(0.3, 0.2, 0.3);
      world.bodies.push_back(b);
    }
  }
  return world;
}

class Reader final : public ReplicaSubscriber {
 public:
  explicit Reader(ReplicaRequest request) : request_(std::make_shared<const ReplicaRequest>(std::move(request))) {}

  State Poll() override {
    const std::lock_guard lock(mutex_);
    return gone_ ? State::kGone : State::kReady;
  }
  bool Send(const grpc::Slice& frame, Tick) override {
    const std::lock_guard lock(mutex_);
    v1::ReplicaFrame parsed;
    std::string error;
    if (counts_ && parsed.ParseFromArray(frame.begin(), static_cast<int>(frame.size()))) decoder_.Apply(parsed, &error);
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
  // Whether frames are read, which costs too.
  void Count(bool on) {
    const std::lock_guard lock(mutex_);
    counts_ = on;
  }
  int bodies() {
    const std::lock_guard lock(mutex_);
    return static_cast<int>(decoder_.bodies());
  }

 private:
  std::mutex mutex_;
  std::shared_ptr<const ReplicaRequest> request_;
  client::ReplicaDecoder decoder_{v1::FINE, false};
  bool gone_ = false, counts_ = true;
};

double CpuUs(clockid_t clock) {
  timespec t{};
  clock_gettime(clock, &t);
  return static_cast<double>(t.tv_sec) * 1e6 + static_cast<double>(t.tv_nsec) * 1e-3;
}

ReplicaRequest BoxAt(double x, double z) {
  v1::StreamReplicasRequest message;
  message.set_rate(1000);
  auto* box = message.mutable_view()->mutable_box();
  box->mutable_min()->set_x(x + 0.1);
  box->mutable_min()->set_z(z + 0.1);
  box->mutable_max()->set_x(x + kViewSide * kSpacing - 0.1);
  box->mutable_max()->set_z(z + kViewSide * kSpacing - 0.1);
  SpecCheck check;
  return ReplicaRequest::Read(Path(), message, 16'000, &check);
}

class Watched {
 public:
  explicit Watched(int side) : world_(Drifting(side)), region_(world_, 0, MakeBulletEngine(world_.environment)) {
    publisher_.Serve(0, 1, world_.environment.tick_us);
  }

  void Join(double x, double z) {
    readers_.push_back(std::make_shared<Reader>(BoxAt(x, z)));
    publisher_.Join(readers_.back());
    while (publisher_.subscribers() < static_cast<int64_t>(readers_.size())) std::this_thread::yield();
  }

  // CPU of one frame: what the tick thread takes, and what the publisher makes of it.
  double Frame(std::vector<double>* tick_us = nullptr) {
    std::vector<aureole::Frame> out;
    const Tick n = region_.tick() + 1;
    while (region_.tick() < n) region_.Advance(&out);
    const double before = CpuUs(CLOCK_PROCESS_CPUTIME_ID), began = CpuUs(CLOCK_THREAD_CPUTIME_ID);
    publisher_.AfterTick(&region_);
    if (tick_us != nullptr) tick_us->push_back(CpuUs(CLOCK_THREAD_CPUTIME_ID) - began);
    while (publisher_.published() < n) std::this_thread::sleep_for(std::chrono::microseconds(20));
    return CpuUs(CLOCK_PROCESS_CPUTIME_ID) - before;
  }
  Reader& reader(size_t i) { return *readers_[i]; }

 private:
  const World world_;
  Region region_;
  ReplicaPublisher publisher_;
  std::vector<std::shared_ptr<Reader>> readers_;
};

}  // namespace

ViewCostResult MeasureViewCost(const ViewCostOptions& options) {
  const int side = static_cast<int>(std::ceil(std::sqrt(options.bodies)));
  Watched large(side), small(kViewSide);
  // In the middle of the large world, at a cell's corner.
  const double middle = std::floor(side / 2.0 / 8) * 8 * kSpacing;
  large.Join(middle, middle);
  small.Join(0, 0);
  ViewCostResult out;
  std::vector<double> large_us, small_us, many_us, large_tick_us, small_tick_us;
  for (int i = 0; i < 3; ++i) {  // the first frames tell everything
    large.Frame();
    small.Frame();
  }
  out.in_view = large.reader(0).bodies();
  large.reader(0).Count(false);
  small.reader(0).Count(false);
  for (int i = 0; i < options.frames; ++i) {
    large_us.push_back(large.Frame(&large_tick_us));
    small_us.push_back(small.Frame(&small_tick_us));
  }
  for (int i = 0; i < kDistinct; ++i) {
    large.Join(middle + kViewSide * kSpacing * (i % 5 - 2), middle + kViewSide * kSpacing * (i / 5 == 0 ? -1 : 1));
    large.reader(static_cast<size_t>(i) + 1).Count(false);
  }
  for (int i = 0; i < 3; ++i) large.Frame();
  for (int i = 0; i < options.frames / 2; ++i) many_us.push_back(large.Frame());
  out.large_us = Median(large_us);
  out.small_us = Median(small_us);
  out.large_tick_us = Median(large_tick_us);
  out.small_tick_us = Median(small_tick_us);
  out.ratio = out.large_us / out.small_us;
  out.distinct_us = (Median(many_us) - out.large_us) / kDistinct;
  return out;
}

}  // namespace aureole
