// The tick of the fixed-delay exchange, and its transfers.
#include "server/core/delayed_exchange.h"

#include <algorithm>

#include <absl/container/flat_hash_set.h>

#include "server/core/apply_input.h"
#include "server/core/check.h"

namespace aureole {

DelayedExchange::DelayedExchange(Holdings& holdings)
    : h_(holdings), k_(h_.world.exchange.k), margins_(MarginsFor(h_.world)), scratch_(h_.engine->Scratch()) {
  const Tolerances& t = h_.world.tolerances;
  step_ = t.speed * static_cast<double>(t.tick_us) * 1e-6 + h_.world.exchange.recovery;
  reach_ = h_.world.exchange.policy == AuraPolicy::kReach;
}

bool DelayedExchange::Ready() const {
  std::vector<RegionId> missing;
  Missing(&missing);
  return missing.empty();
}

void DelayedExchange::Missing(std::vector<RegionId>* out) const {
  const Tick due = DueFrame();
  if (due < 0) return;
  for (RegionId p : h_.peers) {
    const Frame* f = h_.inboxes.at(p).Front();
    if (f == nullptr) {
      out->push_back(p);
    } else {
      AUREOLE_CHECK(f->tick == due, "region %d sent the frame of tick %lld where %lld was due", p,
                    static_cast<long long>(f->tick), static_cast<long long>(due));
    }
  }
}

void DelayedExchange::Advance(std::vector<Frame>* out) {
  if (!started_) {  // state 0: everybody must know of it before tick 1
    started_ = true;
    AnnounceKicks();
    CountHomes();
    SetBounds();
    BoundaryNetworkUpdate(out);
    return;
  }
  if (phase_ == Phase::kBegin) {
    Begin();
    phase_ = Phase::kStep;
    return;
  }
  h_.MeasureSlack(now());
  h_.engine->Step(now());
  ++h_.tick;
  AnnounceSpawns();
  AnnounceKicks();
  DropOldShadows();
  CountHomes();
  Detect();
  BoundaryNetworkUpdate(out);
  phase_ = Phase::kBegin;
}

void DelayedExchange::AppendAuras(size_t most, std::vector<WireBox>* out) const {
  absl::flat_hash_set<BodyId> seen;
  for (const auto& [peer, told] : told_) {
    for (const auto& [id, aura] : told) {
      if (seen.size() < most && seen.insert(id).second) out->push_back(aura.box);
    }
  }
}

void DelayedExchange::ObserveInFlight(std::vector<BodyRecord>* out) const {
  const Tick n = h_.tick;
  for (const auto& [id, s] : shadows_) {
    // Before step n+1 a body sent at n+1-k or earlier is its receiver's; in state n its receiver does not have it
    // yet.
    const bool stepping = phase_ == Phase::kStep;
    if ((stepping ? n + 1 : n) - s.sent >= k_) continue;
    const Shadow::State& state = s.states[n - s.sent];
    if (stepping ? state.steps : state.exists) out->push_back({id, s.epoch, state.hash, -1 - s.group, state.box});
  }
}

Tick DelayedExchange::DueFrame() const {
  if (!started_ || phase_ != Phase::kBegin) return -1;
  if (now() == 1) return 0;
  return now() <= k_ ? -1 : now() - k_;
}

void DelayedExchange::Begin() {
  if (const Tick due = DueFrame(); due >= 0) {
    for (RegionId peer : h_.peers) Apply(h_.inboxes.at(peer).Pop(), peer);
    HearInputs(due);
  }
  std::vector<Input> inputs;
  h_.AppendInputs(now(), &inputs);
  h_.live.ForgetBefore(now() + 1);
  // Spawns have been announced; their owner holds them as pending.
  std::erase_if(inputs, [](const Input& i) { return i.kind == Input::Kind::kSpawn; });
  const auto due =
      std::find_if(h_.pending.begin(), h_.pending.end(), [this](const Input& i) { return i.tick > now(); });
  inputs.insert(inputs.end(), h_.pending.begin(), due);
  h_.pending.erase(h_.pending.begin(), due);
  std::sort(inputs.begin(), inputs.end());
  for (const Input& i : inputs) {
    if (i.kind == Input::Kind::kSpawn) waiting_.erase(i.body);
    h_.Apply(i);
  }
}

void DelayedExchange::HearInputs(Tick n) {
  std::vector<Graph> said = std::exchange(said_[n], {});
  said_.erase(n);
  std::sort(said.begin(), said.end(), [](const Graph& x, const Graph& y) { return x.of < y.of; });
  for (const Graph& g : said) h_.live.Heard(g.applied);
  // What took effect in tick n was said in its frame at the latest.
  h_.live.Settle(n);
  // Whoever sends a cluster knows what acts on it in flight when that was heard before: 2k ticks. `reach` also shows k
  // ticks ahead what may act within its horizon.
  const Tick effect = n + 2 * k_ + (reach_ ? margins_.horizon + 1 : 0);
  // A spawn is announced as early as one of the script: at the end of this tick.
  const Tick spawn_effect = now() + margins_.spawn_notice;
  for (const Graph& g : said) h_.live.Deliver(g.inputs, effect, spawn_effect, g.of == h_.self);
}

void DelayedExchange::Apply(Frame f, RegionId peer) {
  said_[f.tick].insert(said_[f.tick].end(), f.graphs.begin(), f.graphs.end());
  auto& auras = remote_[peer];
  for (BodyId id : f.gone) auras.erase(id);
  for (const Aura& a : f.auras) auras[a.id] = a;
  auto& away = away_[peer];
  for (BodyId id : f.away_gone) away.erase(id);
  for (const Away& a : f.away) away[a.id] = a;
  for (Transfer& t : f.transfers) {
    FindLiveSpawns(&t);
    h_.Arrive(t, peer, now());
    for (const Input& i : t.pending) {
      if (i.kind == Input::Kind::kSpawn) waiting_[i.body] = ViewOf(*i.spawn);
    }
    for (BodyId id : t.ids) shadows_.erase(id);
    CheckArrival(t);
  }
}

// Every region heard of it before its owner could send it on.
void DelayedExchange::FindLiveSpawns(Transfer* t) const {
  for (Input& i : t->pending) {
    if (i.spawn != nullptr) continue;
    const Input* spawn = h_.live.due().FindSpawn(i.tick, i.body);
    AUREOLE_CHECK(spawn != nullptr, "region %d was sent body %llu, which no client spawns at tick %lld", h_.self,
                  static_cast<unsigned long long>(i.body), static_cast<long long>(i.tick));
    i = *spawn;
  }
}

void DelayedExchange::CheckArrival(const Transfer& t) {
  const double dt = h_.world.environment.dt();
  std::vector<BodyId> hits;
  for (BodyId id : t.ids) {
    if (!h_.engine->Contains(id)) continue;
    const BodyView mine = h_.engine->View(id);
    hits.clear();
    h_.engine->Query(mine.box, &hits);
    for (BodyId other : hits) {
      if (std::binary_search(t.ids.begin(), t.ids.end(), other) || h_.held.at(other).arrived == now()) continue;
      const BodyView theirs = h_.engine->View(other);
      const Vec3 back = (theirs.velocity - mine.velocity) * dt;
      const double gap = Gap({mine.box.min + back, mine.box.max + back}, theirs.box);
      if (gap < -h_.world.exchange.recovery - 1e-9) {
        h_.Report({now(), other, id, -gap, std::max(mine.velocity.norm(), theirs.velocity.norm())});
      }
    }
  }
}

BodyView DelayedExchange::ViewOf(const BodySpec& spec) const {
  scratch_->Spawn(spec);
  const BodyView v = scratch_->View(spec.id);
  scratch_->Extract(std::vector<BodyId>{spec.id});
  return v;
}

void DelayedExchange::AnnounceSpawns() {
  std::vector<Input> inputs;
  ScriptedInputs(h_.world, h_.tick + margins_.spawn_notice, &inputs);
  h_.live.due().AppendDue(h_.tick + margins_.spawn_notice, &inputs);
  for (Input& i : inputs) {
    if (i.kind != Input::Kind::kSpawn || h_.layout().Home(i.spawn->position) != h_.self) continue;
    i.body = i.spawn->id;
    h_.pending.insert(std::upper_bound(h_.pending.begin(), h_.pending.end(), i), i);
  }
  for (Input& i : h_.pending) {
    if (i.kind != Input::Kind::kSpawn || waiting_.contains(i.spawn->id)) continue;
    waiting_[i.spawn->id] = ViewOf(*i.spawn);
    h_.held.try_emplace(i.spawn->id);
  }
}

void DelayedExchange::DropOldShadows() {
  absl::erase_if(shadows_, [this](const auto& e) { return h_.tick >= e.second.sent + 2 * k_; });
}

const BodyView DelayedExchange::OwnView(BodyId id) const {
  auto it = waiting_.find(id);
  return it == waiting_.end() ? h_.engine->View(id) : it->second;
}

void DelayedExchange::Send(std::vector<BodyId> ids, RegionId to, TransferCause cause) {
  std::sort(ids.begin(), ids.end());
  std::vector<BodyId> existing;
  for (BodyId id : ids) {
    moved_.push_back(SphereBox(OwnView(id)));
    if (h_.engine->Contains(id)) existing.push_back(id);
  }
  ++groups_;
  for (BodyId id : ids) {
    Shadow s;
    s.owner = to;
    s.epoch = h_.held.at(id).epoch + 1;
    s.sent = h_.tick;
    s.group = (groups_ * h_.layout().size()) + h_.self;
    s.states.push_back(StateOf(*h_.engine, id, OwnView(id)));
    if (auto b = bounds_.find(id); b != bounds_.end()) s.bound = b->second;
    shadows_[id] = std::move(s);
  }
  Transfer t = h_.Depart(ids, to, cause);
  if (!existing.empty()) t.state = h_.engine->Extract(existing);
  FastForward(&t);
  for (BodyId id : ids) waiting_.erase(id);
  if (!t.ids.empty()) leaving_[to].push_back(std::move(t));
}

DelayedExchange::Shadow::State DelayedExchange::StateOf(const Engine& engine, BodyId id, const BodyView& last) {
  Shadow::State s;
  s.exists = engine.Contains(id);
  s.view = s.exists ? engine.View(id) : last;
  s.box = s.view.box;
  if (s.exists) s.hash = engine.Hash(id);
  return s;
}

void DelayedExchange::FastForward(Transfer* t) {
  if (k_ == 1) return;
  if (!t->state.empty()) {
    const absl::Status s = scratch_->Restore(t->state);
    AUREOLE_CHECK(s.ok(), "own state of body %llu: %s", static_cast<unsigned long long>(t->ids[0]),
                  std::string(s.message()).c_str());
  }
  for (Tick n = now(); n < now() + k_ - 1; ++n) {
    std::vector<Input> inputs;
    h_.AppendInputs(n, &inputs);
    std::erase_if(inputs, [](const Input& i) { return i.kind == Input::Kind::kSpawn; });
    const auto due = std::find_if(t->pending.begin(), t->pending.end(), [n](const Input& i) { return i.tick > n; });
    inputs.insert(inputs.end(), t->pending.begin(), due);
    t->pending.erase(t->pending.begin(), due);
    std::sort(inputs.begin(), inputs.end());
    for (const Input& i : inputs) {
      const int64_t bodies = ApplyInput(i, scratch_.get());
      if (i.source != 0) h_.live.Applied(i, bodies);
    }
    for (BodyId id : t->ids) {
      Shadow::State& s = shadows_.at(id).states.back();
      const Shadow::State before = StateOf(*scratch_, id, s.view);
      s.steps = before.exists;
      s.box = before.box;
    }
    scratch_->Step(n);
    for (BodyId id : t->ids) {
      auto& states = shadows_.at(id).states;
      states.push_back(StateOf(*scratch_, id, states.back().view));
    }
  }
  ForgetRemoved(t);
  const std::vector<BodyId> ids = scratch_->Ids();
  t->state = ids.empty() ? std::string() : scratch_->Extract(ids);
}

void DelayedExchange::ForgetRemoved(Transfer* t) const {
  size_t kept = 0;
  for (size_t i = 0; i < t->ids.size(); ++i) {
    const BodyId id = t->ids[i];
    const bool spawns = std::any_of(t->pending.begin(), t->pending.end(),
                                    [id](const Input& in) { return in.kind == Input::Kind::kSpawn && in.body == id; });
    if (!spawns && !scratch_->Contains(id)) continue;
    t->ids[kept] = id;
    t->epochs[kept++] = t->epochs[i];
  }
  t->ids.resize(kept);
  t->epochs.resize(kept);
}

std::unique_ptr<Protocol> MakeDelayedExchange(Holdings& holdings) {
  return std::make_unique<DelayedExchange>(holdings);
}

}  // namespace aureole
