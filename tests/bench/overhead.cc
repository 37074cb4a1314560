#include "tests/bench/overhead.h"

#include <algorithm>
#include <memory>
#include <utility>
#include <vector>

#include "server/core/region.h"
#include "server/physics/bullet_engine.h"
#include "server/physics/plain_bullet_world.h"
#include "tests/bench/heap_world.h"
#include "tests/bench/quantile.h"
#include "tests/bench/thread_time.h"

namespace aureole {
namespace {

class Race {
 public:
  explicit Race(int bodies)
      : world_(HeapWorld(bodies)),
        region_(world_, 0, MakeBulletEngine(world_.environment)),
        stock_(world_.environment) {
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
