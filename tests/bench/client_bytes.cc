#include "tests/bench/client_bytes.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <mutex>
#include <random>
#include <thread>
#include <utility>

#include "aureole/v1/simulation.pb.h"
#include "client/src/replica_decoder.h"
#include "server/core/region.h"
#include "server/physics/bullet_engine.h"
#include "server/transport/replica_publisher.h"

namespace aureole {
namespace {

constexpr Tick kWarmUp = 60;

std::shared_ptr<const Shape> Cube(double half) {
  auto s = std::make_shared<Shape>();
  s->kind = ShapeKind::kBox;
  s->half = Vec3::Constant(half);
  return s;
}

World Floor() {
  World world(Layout::Columns({}).value());
  auto plane = std::make_shared<Shape>();
  plane->kind = ShapeKind::kPlane;
  BodySpec floor;
  floor.id = 1;
  floor.motion = Motion::kStatic;
  floor.shape = plane;
  world.environment.fixed.push_back(floor);
  return world;
}

void AddKick(World* world, Tick n, BodyId body, const Vec3& velocity, const Vec3& spin) {
  Input kick;
  kick.kind = Input::Kind::kVelocity;
  kick.tick = n;
  kick.sequence = world->script.size() + 1;
  kick.body = body;
  kick.linear = velocity;
  kick.angular = spin;
  world->script.push_back(kick);
}

// Cubes on a floor, 4 m apart; a share of them is thrown into the air again and again.
World Thrown(int bodies, double share, Tick ticks) {
  World world = Floor();
  std::mt19937_64 random(1);
  std::uniform_real_distribution<double> unit(-1, 1);
  const int side = static_cast<int>(std::ceil(std::sqrt(bodies)));
  for (int i = 0; i < bodies; ++i) {
    BodySpec b;
    b.id = 1000 + static_cast<BodyId>(i);
    b.shape = Cube(0.4);
    b.position = {4.0 * (i % side), 0.4, 4.0 * (i / side)};
    world.bodies.push_back(b);
  }
  for (Tick n = 1; n <= ticks; ++n) {
    for (int i = 0; i < bodies; ++i) {
      const bool thrown = std::fmod(0.618034 * i, 1.0) < share;
      if (!thrown || (n + 7 * i) % 45 != 0) continue;
      AddKick(&world, n, 1000 + static_cast<BodyId>(i), {2 * unit(random), 3.5 + unit(random), 2 * unit(random)},
              {6 * unit(random), 6 * unit(random), 6 * unit(random)});
    }
  }
  return world;
}

// A large cube is driven through 900 small ones, at 60 ticks per second.
World Fiedler(Tick ticks) {
  World world = Floor();
  world.environment.tick_us = 16667;
  for (int i = 0; i < 900; ++i) {
    BodySpec b;
    b.id = 1000 + static_cast<BodyId>(i);
    b.shape = Cube(0.2);
    b.mass = 0.5;
    b.position = {1.2 * (i % 30), 0.2, 1.2 * (i / 30)};
    world.bodies.push_back(b);
  }
  BodySpec player;
  player.id = 999;
  player.shape = Cube(0.75);
  player.mass = 20;
  player.position = {-2, 0.75, -2};
  world.bodies.insert(world.bodies.begin(), player);
  for (Tick n = 30; n <= ticks; n += 10) {
    const double turn = 0.0035 * static_cast<double>(n);
    AddKick(&world, n, 999, {3 * std::cos(turn), 0, 3 * std::abs(std::sin(turn))}, Vec3::Zero());
  }
  return world;
}

// Reads every frame at once.
class Reader final : public ReplicaSubscriber {
 public:
  Reader(const v1::StreamReplicasRequest& request, int64_t tick_us) : decoder_(v1::FINE, false) {
    SpecCheck check;
    request_ = std::make_shared<const ReplicaRequest>(ReplicaRequest::Read(Path(), request, tick_us, &check));
  }
  State Poll() override { return State::kReady; }
  bool Send(const grpc::Slice& frame, Tick) override {
    v1::ReplicaFrame parsed;
    std::string error;
    if (!parsed.ParseFromArray(frame.begin(), static_cast<int>(frame.size())) || !decoder_.Apply(parsed, &error)) {
      std::abort();
    }
    const std::lock_guard lock(mutex_);
    bytes_ += static_cast<int64_t>(frame.size());
    std::vector<uint64_t> changed = decoder_.changed();
    std::sort(changed.begin(), changed.end());
    changed_ += std::unique(changed.begin(), changed.end()) - changed.begin();
    ++frames_;
    return true;
  }
  std::shared_ptr<const ReplicaRequest> TakeRequest() override { return std::exchange(request_, nullptr); }
  void End(const grpc::Status&) override {}

  struct Count {
    int64_t frames = 0, bytes = 0, changed = 0;
  };
  // Since the last call.
  Count Take() {
    const std::lock_guard lock(mutex_);
    return {std::exchange(frames_, 0), std::exchange(bytes_, 0), std::exchange(changed_, 0)};
  }

 private:
  std::shared_ptr<const ReplicaRequest> request_;
  client::ReplicaDecoder decoder_;
  std::mutex mutex_;
  int64_t frames_ = 0, bytes_ = 0, changed_ = 0;
};

// Runs a world with one reader of every kind, and looks at them after each second.
class Watched {
 public:
  struct Kind {
    v1::CellEncoding encoding;
    int period;
  };
  static constexpr Kind kKinds[] = {{v1::COLUMNS, 1}, {v1::COLUMNS, 6}, {v1::BITS, 1}, {v1::BITS, 6}};

  explicit Watched(const World& world) : world_(world), region_(world_, 0, MakeBulletEngine(world_.environment)) {
    publisher_.Serve(0, 1, world_.environment.tick_us);
    for (const Kind& kind : kKinds) {
      v1::StreamReplicasRequest request;
      request.set_rate(1e6 / static_cast<double>(world_.environment.tick_us * kind.period));
      request.set_encoding(kind.encoding);
      readers_.push_back(std::make_shared<Reader>(request, world_.environment.tick_us));
      publisher_.Join(readers_.back());
    }
    while (publisher_.subscribers() < static_cast<int64_t>(readers_.size())) std::this_thread::yield();
  }

  void Step() {
    std::vector<Frame> none;
    const Tick n = region_.tick() + 1;
    while (region_.tick() < n) region_.Advance(&none);
    publisher_.AfterTick(&region_);
    while (publisher_.published() < n) std::this_thread::yield();
  }

  Reader& reader(size_t i) { return *readers_[i]; }
  Region& region() { return region_; }

 private:
  const World world_;
  Region region_;
  std::vector<std::shared_ptr<Reader>> readers_;
  ReplicaPublisher publisher_;
};

void AddRows(const std::string& scene, Watched* watched, double bodies, double seconds, ClientBytesResult* result) {
  for (size_t i = 0; i < std::size(Watched::kKinds); ++i) {
    const Watched::Kind& kind = Watched::kKinds[i];
    const Reader::Count c = watched->reader(i).Take();
    const double frames = bodies * static_cast<double>(c.frames);
    result->rows.push_back({scene, kind.encoding == v1::BITS ? "bits" : "columns", kind.period,
                            static_cast<double>(c.changed) / frames, static_cast<double>(c.bytes) / frames,
                            static_cast<double>(c.bytes) * 8e-3 / seconds});
  }
  result->state_hash += watched->region().StateHash();
}

void RunThrown(const std::string& scene, double share, const ClientBytesOptions& options, ClientBytesResult* result) {
  const Tick ticks = kWarmUp + options.ticks;
  const World world = Thrown(options.bodies, share, ticks);
  Watched watched(world);
  for (Tick n = 1; n <= kWarmUp; ++n) watched.Step();
  for (size_t i = 0; i < std::size(Watched::kKinds); ++i) watched.reader(i).Take();
  for (Tick n = 0; n < options.ticks; ++n) watched.Step();
  AddRows(scene, &watched, options.bodies, options.ticks * world.environment.dt(), result);
}

void RunFiedler(const ClientBytesOptions& options, ClientBytesResult* result) {
  const Tick ticks = kWarmUp + 2 * options.ticks;
  const World world = Fiedler(ticks);
  Watched watched(world);
  for (Tick n = 1; n <= kWarmUp; ++n) watched.Step();
  watched.reader(0).Take();
  for (Tick n = 0; n < 2 * options.ticks; n += 60) {
    for (int i = 0; i < 60; ++i) watched.Step();
    const Reader::Count c = watched.reader(0).Take();
    const double moving = static_cast<double>(c.changed) / (901.0 * static_cast<double>(c.frames));
    const double kbit = static_cast<double>(c.bytes) * 8e-3;
    result->rows.push_back({"901 cubes", "columns", 1, moving,
                            static_cast<double>(c.bytes) / (901.0 * static_cast<double>(c.frames)), kbit});
    if (moving > 0.04) continue;
    ++result->quiet_seconds;
    result->quiet_kbit_per_s = std::max(result->quiet_kbit_per_s, kbit);
  }
  result->state_hash += watched.region().StateHash();
}

}  // namespace

ClientBytesResult MeasureClientBytes(const ClientBytesOptions& options) {
  ClientBytesResult result;
  RunThrown("all thrown", 1, options, &result);
  RunThrown("20 % thrown", 0.2, options, &result);
  RunThrown("at rest", 0, options, &result);
  RunFiedler(options, &result);
  return result;
}

}  // namespace aureole
