#include "tests/bench/overhead.h"

#include <ctime>

#include <algorithm>
#include <cmath>
#include <memory>
#include <utility>
#include <vector>

#include "server/core/region.h"
#include "server/physics/bullet_engine.h"
#include "server/physics/plain_bullet_world.h"
#include "tests/bench/quantile.h"

namespace aureole {
namespace {

double ThreadSeconds() {
  timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return static_cast<double>(t.tv_sec) + static_cast<double>(t.tv_nsec) * 1e-9;
}

std::shared_ptr<const Shape> MakeShape(int i) {
  auto s = std::make_shared<Shape>();
  const double size = 0.3 + 0.02 * (i % 7);
  switch (i % 3) {
    case 0:
      s->kind = ShapeKind::kSphere;
      s->radius = size;
      break;
    case 1:
      s->kind = ShapeKind::kBox;
      s->half = Vec3(size, 0.8 * size, 1.2 * size);
      break;
    default:
      s->kind = ShapeKind::kCapsule;
      s->radius = 0.7 * size;
      s->half.y() = 1.5 * size;
  }
  return s;
}

BodySpec Fixed(BodyId id, std::shared_ptr<const Shape> shape, const Vec3& position) {
  BodySpec b;
  b.id = id;
  b.motion = Motion::kStatic;
  b.shape = std::move(shape);
  b.position = position;
  return b;
}

// Bodies fall into a pit of 9 m by 9 m; nothing sleeps.
World Heap(int bodies) {
  World world(Layout::Columns({}).value());
  world.environment.sleep_linear = 0;
  auto plane = std::make_shared<Shape>();
  plane->kind = ShapeKind::kPlane;
  world.environment.fixed.push_back(Fixed(1, plane, Vec3::Zero()));
  for (int wall = 0; wall < 4; ++wall) {
    auto box = std::make_shared<Shape>();
    box->kind = ShapeKind::kBox;
    box->half = wall < 2 ? Vec3(0.5, 10, 6) : Vec3(6, 10, 0.5);
    const double at = wall % 2 == 0 ? -5 : 5;
    world.environment.fixed.push_back(
        Fixed(2 + static_cast<BodyId>(wall), box, wall < 2 ? Vec3(at, 10, 0) : Vec3(0, 10, at)));
  }
  for (int i = 0; i < bodies; ++i) {
    BodySpec b;
    b.id = 1000 + static_cast<BodyId>(i);
    b.shape = MakeShape(i);
    b.mass = 1 + 0.1 * (i % 11);
    b.position = Vec3(-3.6 + 1.2 * (i % 7), 1 + 1.1 * (i / 49), -3.6 + 1.2 * (i / 7 % 7));
    b.orientation = Quat(Eigen::AngleAxisd(0.1 * i, Vec3(1, 2, 3).normalized()));
    world.bodies.push_back(std::move(b));
  }
  return world;
}

class Race {
 public:
  explicit Race(int bodies)
      : world_(Heap(bodies)), region_(world_, 0, MakeBulletEngine(world_.environment)), stock_(world_.environment) {
    for (const BodySpec& b : world_.bodies) stock_.Spawn(b);
  }

  double Region(int ticks) {
    const double begin = ThreadSeconds();
    const Tick end = region_.tick() + ticks;
    while (region_.tick() < end) {
      frames_.clear();
      region_.Advance(&frames_);
    }
    return (ThreadSeconds() - begin) / ticks;
  }
  double Stock(int ticks) {
    const double begin = ThreadSeconds();
    for (int i = 0; i < ticks; ++i) stock_.Step(++stock_tick_);
    return (ThreadSeconds() - begin) / ticks;
  }

  const aureole::Region& region() const { return region_; }
  const PlainBulletWorld& stock() const { return stock_; }

 private:
  const World world_;
  aureole::Region region_;
  PlainBulletWorld stock_;
  Tick stock_tick_ = 0;
  std::vector<Frame> frames_;
};

}  // namespace

OverheadResult MeasureOverhead(const OverheadOptions& options) {
  Race race(options.bodies);
  race.Region(options.warm_up);
  race.Stock(options.warm_up);
  std::vector<double> region, stock, ratio;
  for (int i = 0; i < options.blocks; ++i) {
    double r = 0, s = 0;
    if (i % 2 == 0) {  // whoever comes second finds the caches of the other
      r = race.Region(options.block);
      s = race.Stock(options.block);
    } else {
      s = race.Stock(options.block);
      r = race.Region(options.block);
    }
    region.push_back(r * 1e3);
    stock.push_back(s * 1e3);
    ratio.push_back(r / s);
  }
  OverheadResult result;
  result.region_ms = Median(region);
  result.stock_ms = Median(stock);
  result.ratio_median = Median(ratio);
  result.ratio_low = Quantile(ratio, 0.25);
  result.ratio_high = Quantile(ratio, 0.75);
  result.region_contacts = race.region().engine().Counts().contacts;
  result.stock_contacts = race.stock().CountContacts();
  result.state_hash = race.region().StateHash();
  return result;
}

}  // namespace aureole
