#include "server/core/holdings.h"

#include <algorithm>
#include <cmath>

#include <absl/strings/str_cat.h>

#include "server/core/apply_input.h"
#include "server/core/check.h"

namespace aureole {
namespace {

constexpr size_t kMaxViolations = 64;
// Ticks that a peer may be ahead: it waits for us long before, but says again what it said to the region that died
// here.
constexpr Tick kMaxLead = 1 << 14;

bool Finite(const WireBox& b) {
  for (int i = 0; i < 3; ++i) {
    if (!std::isfinite(b.min[i]) || !std::isfinite(b.max[i]) || b.min[i] > b.max[i]) return false;
  }
  return true;
}

template <class List, class Key>
bool Ascending(const List& list, Key key) {
  for (size_t i = 0; i < list.size(); ++i) {
    if (key(list[i]) == 0 || (i > 0 && key(list[i]) <= key(list[i - 1]))) return false;
  }
  return true;
}

absl::Status Malformed(const char* field, const char* why) {
  return absl::InvalidArgumentError(absl::StrCat("frame.", field, ": ", why));
}

absl::Status ValidateGraph(const Graph& g) {
  for (const Edge& e : g.edges) {
    if (e.a == 0 || e.a >= e.b) return Malformed("graphs.edges", "a must be less than b");
  }
  for (const Fragment& f : g.fragments) {
    if (f.known.empty() || !Ascending(f.known, [](BodyId id) { return id; })) {
      return Malformed("graphs.fragments.known", "ids must ascend");
    }
    if (f.mass_by_home.empty()) return Malformed("graphs.fragments.mass_by_home", "must not be empty");
    for (const auto& [home, kg] : f.mass_by_home) {
      if (!std::isfinite(kg) || kg <= 0) return Malformed("graphs.fragments.mass_by_home", "must be > 0 kg");
    }
  }
  for (const Input& i : g.inputs) {
    if (absl::Status s = CheckLiveInput(i); !s.ok())
      return Malformed("graphs.inputs", std::string(s.message()).c_str());
  }
  for (const LateAura& l : g.late) {
    if (l.aura.id == 0 || !Finite(l.aura.box)) return Malformed("graphs.late", "must have an id and a finite box");
  }
  return absl::OkStatus();
}

// Every round of the synchronous exchange says one kind of thing.
absl::Status ValidateRound(const Frame& f) {
  const bool boxes = f.round == kBoxes, transfers = f.round == kTransfers;
  if (f.round < kBoxes || f.round > kWelcome) return Malformed("round", "no such round");
  if ((f.round == kWelcome) == f.welcome.empty()) return Malformed("welcome", "in its round, and only there");
  if (!boxes && !(f.auras.empty() && f.gone.empty())) return Malformed("auras", "not in this round");
  if ((boxes || transfers || f.round == kWelcome) && !f.graphs.empty()) return Malformed("graphs", "not in this round");
  if (transfers == f.transfers.empty()) return Malformed("transfers", "in the last round, and only there");
  if (!f.away.empty() || !f.away_gone.empty()) return Malformed("away", "not in a synchronous exchange");
  return absl::OkStatus();
}

absl::Status Validate(const Frame& f) {
  auto identity = [](BodyId id) { return id; };
  if (!Ascending(f.auras, [](const Aura& a) { return a.id; })) return Malformed("auras", "ids must ascend");
  for (const Aura& a : f.auras) {
    if (!Finite(a.box)) return Malformed("auras.box", "must be finite and not inverted");
  }
  if (!Ascending(f.gone, identity)) return Malformed("gone", "ids must ascend");
  if (!Ascending(f.away, [](const Away& a) { return a.id; })) return Malformed("away", "ids must ascend");
  for (const Away& a : f.away) {
    if (!Finite(a.box)) return Malformed("away.box", "must be finite and not inverted");
  }
  if (!Ascending(f.away_gone, identity)) return Malformed("away_gone", "ids must ascend");
  if (!Ascending(f.graphs, [](const Graph& g) { return g.of + 1; })) return Malformed("graphs", "regions must ascend");
  for (const Graph& g : f.graphs) {
    if (absl::Status s = ValidateGraph(g); !s.ok()) return s;
  }
  for (const Transfer& t : f.transfers) {
    if (t.ids.empty() || !Ascending(t.ids, identity)) return Malformed("transfers.ids", "must ascend");
    if (t.ids.size() != t.epochs.size()) return Malformed("transfers.epochs", "one per id");
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status Inbox::Accept(Frame frame, Tick now, bool synchronous) {
  if (absl::Status s = Validate(frame); !s.ok()) return s;
  if (frame.tick > now + kMaxLead) {
    return absl::InvalidArgumentError(absl::StrCat("frame.tick: ", frame.tick, " is too far ahead of ", now));
  }
  bool follows = false;
  if (synchronous) {
    if (absl::Status s = ValidateRound(frame); !s.ok()) return s;
    follows = frame.tick > 0 && (frame.tick != tick_ ? frame.tick > tick_ : frame.round > round_);
  } else {
    if (!frame.welcome.empty()) return Malformed("welcome", "not with a delay");
    follows = frame.round == 0 && frame.tick == tick_ + 1;
  }
  if (!follows) {
    return absl::InvalidArgumentError(absl::StrCat("frame.tick: (", frame.tick, ", round ", frame.round,
                                                   ") cannot follow (", tick_, ", round ", round_, ")"));
  }
  tick_ = frame.tick;
  round_ = frame.round;
  frames_.push_back(std::move(frame));
  return absl::OkStatus();
}

Frame Inbox::Pop() {
  Frame f = std::move(frames_.front());
  frames_.pop_front();
  ++taken_;
  taken_tick_ = f.tick;
  taken_round_ = f.round;
  return f;
}

Holdings::Holdings(const World& w, RegionId s, std::unique_ptr<Engine> e, Division d)
    : world(w),
      self(s),
      engine(std::move(e)),
      division(std::move(d)),
      live({}, w.exchange.k == 0 ? &division : nullptr) {
  FollowDivision();
}

void Holdings::FollowDivision() {
  rect = self < layout().size() ? layout().rect(self) : Rect{};
  peers.clear();
  for (RegionId r : division.now().members) {
    if (r == self) continue;
    peers.push_back(r);
    inboxes[r];
  }
  for (auto it = inboxes.begin(); it != inboxes.end();) {
    auto& [peer, inbox] = *it;
    const bool member = std::binary_search(peers.begin(), peers.end(), peer);
    if (!member) inbox.Renew();
    if (!member && inbox.Front() == nullptr) {
      inboxes.erase(it++);
    } else {
      ++it;
    }
  }
}

void Holdings::LoadInitialState(double margin) {
  // The boxes come from an engine that holds the whole initial state, so that every region sees the same ones.
  std::unique_ptr<Engine> all = engine->Scratch();
  for (const BodySpec& b : world.bodies) all->Spawn(b);
  std::vector<BodyView> views;
  for (BodyId id : all->Ids()) {
    BodyView v = all->View(id);
    if (margin > 0) v.box = {v.centre.array() - v.radius, v.centre.array() + v.radius};
    views.push_back(v);
  }
  const std::vector<RegionId> owners = InitialOwners(world, views, margin);
  absl::flat_hash_map<BodyId, RegionId> owner;
  for (size_t i = 0; i < views.size(); ++i) owner[views[i].id] = owners[i];
  for (const BodySpec& b : world.bodies) {
    if (owner.at(b.id) != self) continue;
    engine->Spawn(b);
    held[b.id] = {};
  }
  for (const JointSpec& j : world.joints) {
    if (owner.at(j.a) != self) continue;
    AUREOLE_CHECK(j.b == 0 || owner.at(j.b) == self, "joint %llu has two owners",
                  static_cast<unsigned long long>(j.id));
    engine->Join(j);
  }
}

void Holdings::AppendInputs(Tick n, std::vector<Input>* out) const {
  const auto begin = static_cast<std::ptrdiff_t>(out->size());
  ScriptedInputs(world, n, out);
  live.due().AppendDue(n, out);
  std::sort(out->begin() + begin, out->end());
}

void Holdings::Apply(const Input& input) {
  if (watched && input.kind == Input::Kind::kRemove && engine->Contains(input.body)) {
    changes.gone.push_back(
        {input.body, kNoRegion, held.at(input.body).epoch, tick + 1, engine->View(input.body).centre});
  }
  const int64_t bodies = ApplyInput(input, engine.get());
  if (input.kind == Input::Kind::kSpawn) {
    held.try_emplace(input.spawn->id);
    if (watched) changes.came.push_back(input.spawn->id);
  }
  if (input.kind == Input::Kind::kRemove && bodies > 0) held.erase(input.body);
  if (input.source != 0) live.Applied(input, bodies);
}

Transfer Holdings::Depart(std::vector<BodyId> ids, RegionId to, TransferCause cause) {
  Transfer t;
  t.cause = cause;
  for (BodyId id : ids) {
    auto it = held.find(id);
    AUREOLE_CHECK(it != held.end(), "region %d does not own body %llu", self, static_cast<unsigned long long>(id));
    t.epochs.push_back(it->second.epoch + 1);
    if (watched && engine->Contains(id)) {
      const Tick from = tick + std::max(1, world.exchange.k);
      changes.gone.push_back({id, to, t.epochs.back(), from, engine->View(id).centre});
    }
    held.erase(it);
  }
  for (auto it = pending.begin(); it != pending.end();) {
    if (std::binary_search(ids.begin(), ids.end(), it->body)) {
      t.pending.push_back(std::move(*it));
      it = pending.erase(it);
    } else {
      ++it;
    }
  }
  ++stats.transfers_out;
  stats.bodies_out += static_cast<int64_t>(ids.size());
  stats.touching_out += ids.size() > 1;
  stats.returns_out += cause == TransferCause::kBoundaryTraverse;
  stats.largest_cluster = std::max(stats.largest_cluster, static_cast<int64_t>(ids.size()));
  t.ids = std::move(ids);
  return t;
}

void Holdings::Arrive(const Transfer& t, RegionId from, Tick n) {
  if (!t.state.empty()) {
    const absl::Status s = engine->Restore(t.state);
    AUREOLE_CHECK(s.ok(), "transfer of body %llu from region %d to %d at tick %lld: %s",
                  static_cast<unsigned long long>(t.ids[0]), from, self, static_cast<long long>(n),
                  std::string(s.message()).c_str());
  }
  const int64_t transfer = ++stats.transfers_in;
  for (size_t i = 0; i < t.ids.size(); ++i) {
    const bool fresh = held.emplace(t.ids[i], Held{t.epochs[i], n, transfer}).second;
    AUREOLE_CHECK(fresh, "body %llu came from region %d but region %d owns it",
                  static_cast<unsigned long long>(t.ids[i]), from, self);
    if (watched) changes.came.push_back(t.ids[i]);
    if (t.cause == TransferCause::kAuraCollision) newcomers_.emplace_back(t.ids[i], transfer);
  }
  pending.insert(pending.end(), t.pending.begin(), t.pending.end());
  std::sort(pending.begin(), pending.end());
  stats.bodies_in += static_cast<int64_t>(t.ids.size());
}

void Holdings::Report(const Violation& v) {
  ++stats.violations;
  if (violations.size() < kMaxViolations) violations.push_back(v);
}

void Holdings::MeasureSlack(Tick n) {
  std::erase_if(newcomers_, [&](const std::pair<BodyId, int64_t>& newcomer) {
    const auto& [id, transfer] = newcomer;
    const auto it = held.find(id);
    if (it == held.end() || it->second.transfer != transfer) return true;  // removed, or on its way again
    if (!engine->Contains(id)) return false;                               // a spawn to come
    const Tick slack = n - it->second.arrived;
    touched_.clear();
    engine->Query(engine->View(id).box, &touched_);
    const bool met = std::any_of(touched_.begin(), touched_.end(),
                                 [&](BodyId other) { return other != id && held.at(other).transfer != transfer; });
    if (!met && slack < kSlackTicks) return false;
    ++stats.slack[static_cast<size_t>(met ? slack : kSlackTicks)];
    return true;
  });
}

void Holdings::CountHomes(std::span<const BodyId> near) {
  std::vector<std::pair<BodyId, RegionId>> homes;
  homes.reserve(near.size());
  stats.away_bodies = 0;
  auto before = homes_.begin();
  for (BodyId id : near) {
    if (!engine->Contains(id)) continue;
    const RegionId home = layout().Home(engine->View(id).centre);
    while (before != homes_.end() && before->first < id) ++before;
    // Not in the list: it was inside its home, or it has arrived and the sender has counted, or it began where it is.
    if (before != homes_.end() && before->first == id) {
      stats.home_crossings += before->second != home;
    } else if (tick > 0 && held.at(id).arrived < tick) {
      stats.home_crossings += home != self;
    }
    stats.away_bodies += home != self;
    homes.emplace_back(id, home);
  }
  homes_ = std::move(homes);
}

void Holdings::Save(Writer& a) const {
  a(tick, division);
  a.Bytes([this](std::string* out) { engine->SaveTo(engine->Ids(), out); });
  a(held, inboxes, stats, pending, live, newcomers_, homes_);
}

bool Holdings::Load(Reader& a) {
  std::string bodies;
  a(tick, division, bodies, held, inboxes, stats, pending, live, newcomers_, homes_);
  if (!a.ok() || !division.now().IsMember(self)) return false;
  FollowDivision();
  return engine->Restore(bodies).ok();
}

absl::Status CheckRegions(const Frame& frame, const Division::State& division) {
  const auto malformed = [](const char* field) {
    return absl::InvalidArgumentError(absl::StrCat("frame.graphs.", field, ": no such region"));
  };
  const auto home = [&division](RegionId r) {
    return r >= 0 && r < division.layout.size() && division.layout.has_area(r);
  };
  for (const Graph& g : frame.graphs) {
    const auto other = [&](RegionId r) { return r != g.of && division.IsMember(r); };
    if (!division.IsMember(g.of)) return malformed("of");
    if (g.emptied && home(g.of)) return absl::InvalidArgumentError("frame.graphs.emptied: the region has an area");
    for (const Fragment& f : g.fragments) {
      if (f.gives_back != kNoRegion && !home(f.gives_back)) return malformed("fragments.gives_back");
      for (const auto& [region, kg] : f.mass_by_home) {
        if (!home(region)) return malformed("fragments.mass_by_home");
      }
    }
    for (const LateAura& l : g.late) {
      if (!other(l.to)) return malformed("late.to");
    }
    if (!std::all_of(g.opened.begin(), g.opened.end(), other)) return malformed("opened");
    if (!std::all_of(g.closed.begin(), g.closed.end(), other)) return malformed("closed");
  }
  return absl::OkStatus();
}

RegionId Heaviest(const Layout& layout, std::span<const std::pair<RegionId, double>> mass) {
  RegionId best = kNoRegion;
  double most = 0;
  for (const auto& [region, kg] : mass) {
    if (best == kNoRegion || kg > most || (kg == most && layout.rank(region) < layout.rank(best))) {
      best = region;
      most = kg;
    }
  }
  return best;
}

void AddMass(std::vector<std::pair<RegionId, double>>* mass, RegionId home, double kg) {
  auto it = std::lower_bound(mass->begin(), mass->end(), home,
                             [](const std::pair<RegionId, double>& e, RegionId r) { return e.first < r; });
  if (it == mass->end() || it->first != home) it = mass->insert(it, {home, 0.0});
  it->second += kg;
}

}  // namespace aureole
