#include "server/core/region.h"

#include <algorithm>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/core/check.h"
#include "server/core/holdings.h"

namespace aureole {

namespace {

// With a delay, the first frames are used for k ticks, and a decision takes k more to act.
double InitialMargin(const World& world) {
  const int k = world.exchange.k;
  if (k == 0) return 0;
  const double step = world.tolerances.speed * static_cast<double>(world.tolerances.tick_us) * 1e-6;
  return (MarginsFor(world).predict + 4 * k + 2) * step;
}

}  // namespace

struct Region::Impl {
  Impl(const World& world, RegionId self, std::unique_ptr<Engine> engine) : holdings(world, self, std::move(engine)) {}
  Holdings holdings;
  std::unique_ptr<Protocol> protocol;
};

Region::Region(const World& world, RegionId self, std::unique_ptr<Engine> engine)
    : impl_(std::make_unique<Impl>(world, self, std::move(engine))) {
  AUREOLE_CHECK(self >= 0 && self < world.layout.size(), "region %d of %d", self, world.layout.size());
  // What will soon be in reach starts on one region; the exchange keeps it so.
  impl_->holdings.LoadInitialState(InitialMargin(world));
  impl_->protocol = world.exchange.k == 0 ? MakeSyncExchange(impl_->holdings) : MakeDelayedExchange(impl_->holdings);
}
Region::~Region() = default;

RegionId Region::self() const { return impl_->holdings.self; }
Tick Region::tick() const { return impl_->holdings.tick; }
Phase Region::phase() const { return impl_->protocol->phase(); }
const std::vector<RegionId>& Region::peers() const { return impl_->holdings.peers; }

absl::Status Region::Receive(Frame frame) {
  Holdings& h = impl_->holdings;
  auto it = h.inboxes.find(frame.from);
  if (it == h.inboxes.end()) {
    return absl::InvalidArgumentError(absl::StrCat("frame.from: ", frame.from, " is no peer of region ", h.self));
  }
  if (frame.to != h.self && frame.to != kEveryone) {
    return absl::InvalidArgumentError(absl::StrCat("frame.to: ", frame.to, " is not region ", h.self));
  }
  const int regions = h.world.layout.size();
  for (const Fragment& f : frame.fragments) {
    if (f.gives_back != kNoRegion && (f.gives_back < 0 || f.gives_back >= regions)) {
      return absl::InvalidArgumentError("frame.fragments.gives_back: no such region");
    }
    for (const auto& [home, kg] : f.mass_by_home) {
      if (home < 0 || home >= regions) {
        return absl::InvalidArgumentError("frame.fragments.mass_by_home: no such region");
      }
    }
  }
  return it->second.Accept(std::move(frame), h.world.exchange.k == 0);
}

bool Region::Ready() const { return impl_->protocol->Ready(); }
void Region::Missing(std::vector<RegionId>* out) const { impl_->protocol->Missing(out); }

void Region::Advance(std::vector<Frame>* out) {
  AUREOLE_CHECK(Ready(), "region %d advanced without its frames at tick %lld", self(), static_cast<long long>(tick()));
  impl_->protocol->Advance(out);
}

absl::StatusOr<Tick> Region::Submit(Input input) {
  Holdings& h = impl_->holdings;
  if (input.kind == Input::Kind::kSpawn) {
    const RegionId home = h.world.layout.Home(input.spawn->position);
    if (home != h.self) {
      return absl::NotFoundError(absl::StrCat("input.spawn.position: is in region ", home, ", not ", h.self));
    }
    if (h.held.contains(input.spawn->id)) {
      return absl::AlreadyExistsError(absl::StrCat("input.spawn.id: body ", input.spawn->id, " exists"));
    }
  } else if (!h.held.contains(input.body)) {
    auto it = h.sent_to.find(input.body);
    if (it == h.sent_to.end()) {
      return absl::NotFoundError(absl::StrCat("input.body: body ", input.body, " is not in region ", h.self));
    }
    return absl::NotFoundError(absl::StrCat("input.body: body ", input.body, " went to region ", it->second));
  }
  input.tick = impl_->protocol->EffectTick(input);
  h.pending.insert(std::upper_bound(h.pending.begin(), h.pending.end(), input), input);
  h.accepted.push_back(input);
  return input.tick;
}

std::vector<Input> Region::TakeAccepted() { return std::exchange(impl_->holdings.accepted, {}); }

void Region::Observe(std::vector<BodyRecord>* out) const {
  const Holdings& h = impl_->holdings;
  for (BodyId id : h.engine->Ids()) {
    out->push_back({id, h.held.at(id).epoch, h.engine->Hash(id), h.self, h.engine->View(id).box});
  }
  impl_->protocol->ObserveInFlight(out);
}

uint64_t Region::StateHash() const {
  std::vector<BodyRecord> records;
  Observe(&records);
  uint64_t sum = 0;
  for (const BodyRecord& r : records) sum += BodyHash(r.id, r.hash);
  return sum;
}

int64_t Region::bodies() const { return static_cast<int64_t>(impl_->holdings.held.size()); }
const RegionStats& Region::stats() const { return impl_->holdings.stats; }
std::vector<Violation> Region::TakeViolations() { return std::exchange(impl_->holdings.violations, {}); }
const Engine& Region::engine() const { return *impl_->holdings.engine; }

}  // namespace aureole
