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

absl::Status CheckRegions(const Graph& g, int regions) {
  const auto known = [regions](RegionId r) { return r >= 0 && r < regions; };
  const auto all_others = [&](const std::vector<RegionId>& list) {
    return std::all_of(list.begin(), list.end(), [&](RegionId r) { return known(r) && r != g.of; });
  };
  if (!known(g.of)) return absl::InvalidArgumentError("frame.graphs.of: no such region");
  for (const Fragment& f : g.fragments) {
    if (f.gives_back != kNoRegion && !known(f.gives_back)) {
      return absl::InvalidArgumentError("frame.graphs.fragments.gives_back: no such region");
    }
    for (const auto& [home, kg] : f.mass_by_home) {
      if (!known(home)) return absl::InvalidArgumentError("frame.graphs.fragments.mass_by_home: no such region");
    }
  }
  for (const LateAura& l : g.late) {
    if (!known(l.to) || l.to == g.of) return absl::InvalidArgumentError("frame.graphs.late.to: no such region");
  }
  if (!all_others(g.opened)) return absl::InvalidArgumentError("frame.graphs.opened: no such other region");
  if (!all_others(g.closed)) return absl::InvalidArgumentError("frame.graphs.closed: no such other region");
  return absl::OkStatus();
}

// A spawn travels by its name: one of the script is found there, one of a client when the frame is applied.
absl::Status FindSpawn(const World& world, Input* spawn) {
  if (spawn->spawn != nullptr || IsLiveId(spawn->body)) return absl::OkStatus();
  std::vector<Input> script;
  ScriptedInputs(world, spawn->tick, &script);
  for (const Input& i : script) {
    if (i.kind != Input::Kind::kSpawn || i.spawn->id != spawn->body) continue;
    *spawn = i;
    spawn->body = i.spawn->id;
    return absl::OkStatus();
  }
  return absl::InvalidArgumentError(
      absl::StrCat("frame.transfers.pending: no spawn of body ", spawn->body, " at tick ", spawn->tick));
}

}  // namespace

struct Region::Impl {
  Impl(const World& world, RegionId self, std::unique_ptr<Engine> engine) : holdings(world, self, std::move(engine)) {
    AUREOLE_CHECK(self >= 0 && self < world.layout.size(), "region %d of %d", self, world.layout.size());
  }
  void MakeProtocol() {
    protocol = holdings.world.exchange.k == 0 ? MakeSyncExchange(holdings) : MakeDelayedExchange(holdings);
  }
  Holdings holdings;
  std::unique_ptr<Protocol> protocol;
};

Region::Region(const World& world, RegionId self, std::unique_ptr<Engine> engine)
    : impl_(std::make_unique<Impl>(world, self, std::move(engine))) {
  // What will soon be in reach starts on one region; the exchange keeps it so.
  impl_->holdings.LoadInitialState(InitialMargin(world));
  impl_->MakeProtocol();
}

Region::Region(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}

absl::StatusOr<std::unique_ptr<Region>> Region::Load(const World& world, RegionId self, std::unique_ptr<Engine> engine,
                                                     std::string_view saved) {
  auto impl = std::make_unique<Impl>(world, self, std::move(engine));
  impl->MakeProtocol();
  Reader reader(saved);
  RegionId of = kNoRegion;
  int regions = 0;
  reader(of, regions);
  if (of != self || regions != world.layout.size()) {
    return absl::InvalidArgumentError(absl::StrCat("checkpoint: is of region ", of, " of ", regions, ", not of region ",
                                                   self, " of ", world.layout.size()));
  }
  const bool loaded = impl->holdings.Load(reader);
  if (loaded) impl->protocol->Load(reader);
  if (!loaded || !reader.done()) {
    return absl::InvalidArgumentError("checkpoint: is damaged, or was written by another program");
  }
  return std::unique_ptr<Region>(new Region(std::move(impl)));
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
  if (!std::binary_search(frame.to.begin(), frame.to.end(), h.self)) {
    return absl::InvalidArgumentError(absl::StrCat("frame.to: does not name region ", h.self));
  }
  for (const Graph& g : frame.graphs) {
    if (absl::Status s = CheckRegions(g, h.world.layout.size()); !s.ok()) return s;
  }
  for (Transfer& t : frame.transfers) {
    for (Input& i : t.pending) {
      if (absl::Status s = FindSpawn(h.world, &i); !s.ok()) return s;
    }
  }
  if (!impl_->protocol->MaySend(frame.from, frame.round)) {
    return absl::InvalidArgumentError(
        absl::StrCat("frame.round: ", frame.round, " is not for region ", frame.from, " to send to region ", h.self));
  }
  return it->second.Accept(std::move(frame), h.tick, h.world.exchange.k == 0);
}

bool Region::Ready() const { return impl_->protocol->Ready(); }
void Region::Missing(std::vector<RegionId>* out) const { impl_->protocol->Missing(out); }

void Region::Advance(std::vector<Frame>* out) {
  AUREOLE_CHECK(Ready(), "region %d advanced without its frames at tick %lld", self(), static_cast<long long>(tick()));
  impl_->protocol->Advance(out);
}

absl::Status Region::Submit(const Input& input) { return impl_->holdings.live.Offer(input); }
size_t Region::inputs_waiting() const { return impl_->holdings.live.offered(); }
std::vector<InputOutcome> Region::TakeOutcomes() { return impl_->holdings.live.TakeOutcomes(); }
std::vector<Input> Region::TakeDelivered() { return impl_->holdings.live.TakeDelivered(); }

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

RegionSnapshot Region::Snapshot() const {
  const Holdings& h = impl_->holdings;
  AUREOLE_CHECK(h.world.exchange.k == 0 && phase() == Phase::kBegin, "snapshot of region %d within tick %lld", h.self,
                static_cast<long long>(h.tick));
  RegionSnapshot out{h.engine->Save(h.engine->Ids()), {}};
  h.live.due().AppendAfter(h.tick, &out.to_come);
  return out;
}

std::string Region::Save() const {
  AUREOLE_CHECK(phase() == Phase::kBegin, "checkpoint of region %d within tick %lld", self(),
                static_cast<long long>(tick()));
  std::string out;
  Writer writer(&out);
  writer(self(), impl_->holdings.world.layout.size());
  impl_->holdings.Save(writer);
  impl_->protocol->Save(writer);
  return out;
}

uint64_t Region::FramesTaken(RegionId peer) const { return impl_->holdings.inboxes.at(peer).taken(); }

void Region::AppendAuras(size_t most, std::vector<WireBox>* out) const { impl_->protocol->AppendAuras(most, out); }

void Region::WatchChanges(bool on) {
  Holdings& h = impl_->holdings;
  h.watched = on;
  h.changes = {};
  h.engine->NoteSleep(on);
}

BodyChanges Region::TakeChanges() {
  Holdings& h = impl_->holdings;
  h.engine->TakeSleep(&h.changes.slept, &h.changes.woke);
  return std::exchange(h.changes, {});
}

Epoch Region::EpochOf(BodyId id) const { return impl_->holdings.held.at(id).epoch; }

int64_t Region::bodies() const { return static_cast<int64_t>(impl_->holdings.held.size()); }
const RegionStats& Region::stats() const { return impl_->holdings.stats; }
std::vector<Violation> Region::TakeViolations() { return std::exchange(impl_->holdings.violations, {}); }
const Engine& Region::engine() const { return *impl_->holdings.engine; }

}  // namespace aureole
