#include "server/core/region.h"

#include <algorithm>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/core/check.h"
#include "server/core/holdings.h"
#include "server/core/limits.h"

namespace aureole {

namespace {

// With a delay, the first frames are used for k ticks, and a decision takes k more to act.
double InitialMargin(const World& world) {
  const int k = world.exchange.k;
  if (k == 0) return 0;
  const double step = world.tolerances.speed * static_cast<double>(world.tolerances.tick_us) * 1e-6;
  return (MarginsFor(world).predict + 4 * k + 2) * step;
}

absl::Status RefuseWithDelay(const World& world) {
  if (world.exchange.k == 0) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("input.kind: the layout cannot change while the world runs, because its exchange has a delay of ",
                   world.exchange.k, " ticks; use the synchronous exchange"));
}

// It is of the layout with which this region joins, and of the tick before that.
absl::Status CheckWelcome(const Holdings& h, const Frame& frame) {
  Division division = h.division;
  LiveInputs live;
  Reader reader(frame.welcome);
  reader(division);
  live.Learn(reader);
  if (!reader.done()) return absl::InvalidArgumentError("frame.welcome: was written by another program");
  const Division::State &told = division.now(), &own = h.division.now();
  if (told.epoch != own.epoch || told.members != own.members || !(told.layout == own.layout) ||
      division.next_at() != 0) {
    return absl::InvalidArgumentError(absl::StrCat("frame.welcome: to the layout of epoch ", told.epoch,
                                                   ", where region ", h.self, " joins with another of epoch ",
                                                   own.epoch));
  }
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
  Impl(const World& world, RegionId self, std::unique_ptr<Engine> engine, Division division)
      : holdings(world, self, std::move(engine), std::move(division)) {}
  void MakeProtocol(bool joins = false) {
    protocol = holdings.world.exchange.k == 0 ? MakeSyncExchange(holdings, joins) : MakeDelayedExchange(holdings);
  }
  Holdings holdings;
  std::unique_ptr<Protocol> protocol;
};

Region::Region(const World& world, RegionId self, std::unique_ptr<Engine> engine)
    : impl_(std::make_unique<Impl>(world, self, std::move(engine), Division(world.layout))) {
  AUREOLE_CHECK(self >= 0 && self < world.layout.size(), "region %d of %d", self, world.layout.size());
  // What will soon be in reach starts on one region; the exchange keeps it so.
  impl_->holdings.LoadInitialState(InitialMargin(world));
  impl_->MakeProtocol();
}

Region::Region(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}

absl::StatusOr<std::unique_ptr<Region>> Region::Load(const World& world, RegionId self, std::unique_ptr<Engine> engine,
                                                     std::string_view saved) {
  auto impl = std::make_unique<Impl>(world, self, std::move(engine), Division(world.layout));
  Reader reader(saved);
  RegionId of = kNoRegion;
  int regions = 0;
  reader(of, regions);
  if (of != self || regions != world.layout.size()) {
    return absl::InvalidArgumentError(absl::StrCat("checkpoint: is of region ", of, " of ", regions, ", not of region ",
                                                   self, " of ", world.layout.size()));
  }
  const bool loaded = impl->holdings.Load(reader);
  if (loaded) {
    impl->MakeProtocol();
    impl->protocol->Load(reader);
  }
  if (!loaded || !reader.done()) {
    return absl::InvalidArgumentError("checkpoint: is damaged, or was written by another program");
  }
  return std::unique_ptr<Region>(new Region(std::move(impl)));
}

absl::StatusOr<std::unique_ptr<Region>> Region::Join(const World& world, RegionId self, std::unique_ptr<Engine> engine,
                                                     const LayoutChange& change) {
  if (absl::Status s = RefuseWithDelay(world); !s.ok()) return s;
  if (absl::Status s = LayoutOf(change).status(); !s.ok()) return s;
  if (!std::binary_search(change.members.begin(), change.members.end(), self)) {
    return absl::InvalidArgumentError(absl::StrCat("members: must name region ", self, ", which joins"));
  }
  auto impl = std::make_unique<Impl>(world, self, std::move(engine), Division(change));
  impl->MakeProtocol(true);
  return std::unique_ptr<Region>(new Region(std::move(impl)));
}

Region::~Region() = default;

RegionId Region::self() const { return impl_->holdings.self; }
Tick Region::tick() const { return impl_->holdings.tick; }
Phase Region::phase() const { return impl_->protocol->phase(); }
const std::vector<RegionId>& Region::peers() const { return impl_->holdings.peers; }
const Layout& Region::layout() const { return impl_->holdings.layout(); }
uint64_t Region::layout_epoch() const { return impl_->holdings.division.now().epoch; }
const std::vector<RegionId>& Region::members() const { return impl_->holdings.division.now().members; }
Tick Region::next_layout_at() const { return impl_->holdings.division.next_at(); }
const Layout& Region::next_layout() const { return impl_->holdings.division.next().layout; }
const std::vector<RegionId>& Region::next_members() const { return impl_->holdings.division.next().members; }

absl::Status Region::Receive(Frame frame) {
  Holdings& h = impl_->holdings;
  const bool synchronous = h.world.exchange.k == 0, joins = phase() == Phase::kJoin;
  // Null: of a tick whose layout is not known here. That is so in a region that repeats what it had done, and in one
  // that waits for its welcome; when they come there, it is held against the layout (SyncExchange::Pop).
  const Division::State* division = &h.division.now();
  if (joins && frame.round != kWelcome) division = nullptr;
  if (synchronous && !joins) division = h.division.At(frame.tick, h.tick);
  const bool peer = frame.from != h.self && (division != nullptr ? division->IsMember(frame.from)
                                                                 : frame.from >= 0 && frame.from < limits::kMaxRegions);
  if (!peer) {
    return absl::InvalidArgumentError(absl::StrCat("frame.from: ", frame.from, " is no peer of region ", h.self));
  }
  if (!std::binary_search(frame.to.begin(), frame.to.end(), h.self)) {
    return absl::InvalidArgumentError(absl::StrCat("frame.to: does not name region ", h.self));
  }
  if (division != nullptr) {
    if (!division->IsMember(h.self)) {
      return absl::InvalidArgumentError(
          absl::StrCat("frame.tick: region ", h.self, " has no part in tick ", frame.tick));
    }
    if (absl::Status s = CheckRegions(frame, *division); !s.ok()) return s;
    if (!impl_->protocol->MaySend(frame.from, frame.round, *division)) {
      return absl::InvalidArgumentError(
          absl::StrCat("frame.round: ", frame.round, " is not for region ", frame.from, " to send to region ", h.self));
    }
  }
  for (Transfer& t : frame.transfers) {
    for (Input& i : t.pending) {
      if (absl::Status s = FindSpawn(h.world, &i); !s.ok()) return s;
    }
  }
  if (frame.round == kWelcome) {
    if (absl::Status s = CheckWelcome(h, frame); !s.ok()) return s;
  }
  const Tick now = joins ? frame.tick : h.tick;
  Inbox fresh;  // kept only when the frame is good
  const auto it = h.inboxes.find(frame.from);
  const RegionId from = frame.from;
  absl::Status s = (it == h.inboxes.end() ? fresh : it->second).Accept(std::move(frame), now, synchronous);
  if (s.ok() && it == h.inboxes.end()) h.inboxes.emplace(from, std::move(fresh));
  return s;
}

bool Region::Ready() const { return impl_->protocol->Ready(); }
void Region::Missing(std::vector<RegionId>* out) const { impl_->protocol->Missing(out); }

void Region::Advance(std::vector<Frame>* out) {
  AUREOLE_CHECK(Ready(), "region %d advanced without its frames at tick %lld", self(), static_cast<long long>(tick()));
  impl_->protocol->Advance(out);
}

absl::Status Region::Submit(const Input& input) {
  if (input.kind == Input::Kind::kLayout) {
    if (absl::Status s = RefuseWithDelay(impl_->holdings.world); !s.ok()) return s;
  }
  return impl_->holdings.live.Offer(input);
}
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
  std::string out;
  SaveTo(&out);
  return out;
}

void Region::SaveTo(std::string* out) const {
  AUREOLE_CHECK(phase() == Phase::kBegin || phase() == Phase::kLeft, "checkpoint of region %d within tick %lld", self(),
                static_cast<long long>(tick()));
  Writer writer(out);
  writer(self(), impl_->holdings.world.layout.size());
  impl_->holdings.Save(writer);
  impl_->protocol->Save(writer);
}

uint64_t Region::FramesTaken(RegionId peer) const {
  const auto it = impl_->holdings.inboxes.find(peer);
  return it == impl_->holdings.inboxes.end() ? 0 : it->second.taken();
}

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
