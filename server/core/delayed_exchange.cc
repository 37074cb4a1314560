// The fixed-delay exchange, k >= 1: Aura Projection proper (PROTOCOL.md sections 2 to 8). A frame sent after tick n is
// applied before tick n + k, never earlier, never later; what may meet within that horizon is co-hosted ahead of time.
//
// A cluster that is sent is stepped k-1 ticks on its own *by the sender, at once*, and travels as the state in which
// its receiver takes it over. That is the same computation as R2's shadow and the receiver's fast-forward, done once.
#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <map>
#include <set>

#include <absl/container/flat_hash_map.h>

#include "server/core/check.h"
#include "server/core/holdings.h"
#include "server/core/reach.h"
#include "server/core/union_find.h"

namespace aureole {
namespace {

// A body turns faster than its box may grow, so the protocol uses the box of its bounding sphere (PROTOCOL.md, "Gap").
Box SphereBox(const BodyView& v) { return {v.centre.array() - v.radius, v.centre.array() + v.radius}; }

class DelayedExchange final : public Protocol {
 public:
  explicit DelayedExchange(Holdings& holdings)
      : h_(holdings), k_(h_.world.exchange.k), margins_(MarginsFor(h_.world)), scratch_(h_.engine->Scratch()) {
    const Tolerances& t = h_.world.tolerances;
    step_ = t.speed * static_cast<double>(t.tick_us) * 1e-6 + h_.world.exchange.recovery;
    reach_ = h_.world.exchange.policy == AuraPolicy::kReach;
  }

  Phase phase() const override { return phase_; }

  bool Ready() const override {
    std::vector<RegionId> missing;
    Missing(&missing);
    return missing.empty();
  }

  void Missing(std::vector<RegionId>* out) const override {
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

  bool MaySend(RegionId, int round) const override { return round == 0; }

  void Advance(std::vector<Frame>* out) override {
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

  void ObserveInFlight(std::vector<BodyRecord>* out) const override {
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

  Tick EffectTick(const Input& input) const override {
    const Tick next = phase_ == Phase::kBegin ? now() : now() + 1;
    if (input.kind == Input::Kind::kSpawn) return next + margins_.spawn_notice;
    return reach_ ? next + margins_.horizon : next;
  }

 private:
  // R12: what a body can do within the horizon, and what its aura says of it.
  struct Bound {
    double push = 0, give = 0;  // m, as in Node
    BodyId group = 0;
    double energy = 0;  // of the group, J
  };

  // What the sender of a cluster knows of one of its bodies while it is in flight: states sent .. sent+k-1.
  struct Shadow {
    RegionId owner = kNoRegion;
    Epoch epoch = 0;
    Tick sent = 0;
    int64_t group = 0;
    struct State {
      bool exists = false;  // at the end of its tick; false: a spawn that has not taken effect, or removed
      bool steps = false;   // takes part in the next step
      BodyView view;        // at the end of its tick
      Box box;              // exact, as the next step uses it
      uint64_t hash = 0;
    };
    std::vector<State> states;
    Bound bound;  // when it was sent
  };

  // A node of the graph that the decision of this tick looks at (R3).
  struct Node {
    BodyId id;
    RegionId owner;
    Box box;
    bool own;
    double push = 0, give = 0;  // an edge when the gap is at most the sum of both: for AC, and for BT
  };

  Tick now() const { return h_.tick + 1; }

  // The frames that Begin of tick now() needs; -1: none.
  Tick DueFrame() const {
    if (!started_ || phase_ != Phase::kBegin) return -1;
    if (now() == 1) return 0;
    return now() <= k_ ? -1 : now() - k_;
  }

  void Begin() {
    if (DueFrame() >= 0) {
      for (RegionId peer : h_.peers) Apply(h_.inboxes.at(peer).Pop(), peer);
    }
    std::vector<Input> inputs;
    ScriptedInputs(h_.world, now(), &inputs);
    // Scripted spawns have been announced; their owner holds them as pending.
    std::erase_if(inputs, [](const Input& i) { return i.kind == Input::Kind::kSpawn; });
    h_.TakeDueInputs(now(), &inputs);
    std::sort(inputs.begin(), inputs.end());
    for (const Input& i : inputs) {
      if (i.kind == Input::Kind::kSpawn) waiting_.erase(i.body);
      if (i.kind == Input::Kind::kSpawn || h_.engine->Contains(i.body)) h_.ApplyInput(i);
    }
  }

  void Apply(const Frame& f, RegionId peer) {
    auto& auras = remote_[peer];
    for (BodyId id : f.gone) auras.erase(id);
    for (const Aura& a : f.auras) auras[a.id] = a;
    auto& away = away_[peer];
    for (BodyId id : f.away_gone) away.erase(id);
    for (const Away& a : f.away) away[a.id] = a;
    for (const Transfer& t : f.transfers) {
      h_.Arrive(t, peer, now());
      for (const Input& i : t.pending) {
        if (i.kind == Input::Kind::kSpawn) waiting_[i.body] = ViewOf(*i.spawn);
      }
      for (BodyId id : t.ids) shadows_.erase(id);
      CheckArrival(t);
    }
  }

  // A broken horizon: an arrival overlapped an owned body already one step ago, when the two were stepped apart.
  void CheckArrival(const Transfer& t) {
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

  BodyView ViewOf(const BodySpec& spec) const {
    scratch_->Spawn(spec);
    const BodyView v = scratch_->View(spec.id);
    scratch_->Extract(std::vector<BodyId>{spec.id});
    return v;
  }

  // R11: a spawn is shown, owned and transferable from `spawn_notice` ticks before it takes effect.
  void AnnounceSpawns() {
    std::vector<Input> inputs;
    ScriptedInputs(h_.world, h_.tick + margins_.spawn_notice, &inputs);
    for (Input& i : inputs) {
      if (i.kind != Input::Kind::kSpawn || h_.world.layout.Home(i.spawn->position) != h_.self) continue;
      i.body = i.spawn->id;
      h_.pending.insert(std::upper_bound(h_.pending.begin(), h_.pending.end(), i), i);
    }
    for (Input& i : h_.pending) {
      if (i.kind != Input::Kind::kSpawn || waiting_.contains(i.spawn->id)) continue;
      waiting_[i.spawn->id] = ViewOf(*i.spawn);
      h_.held.try_emplace(i.spawn->id);
    }
  }

  void DropOldShadows() {
    absl::erase_if(shadows_, [this](const auto& e) { return h_.tick >= e.second.sent + 2 * k_; });
  }

  void CountHomes() {
    near_.clear();
    h_.engine->CollectOutside(h_.rect, ProjectReach() + h_.engine->MaxRadius(), &near_);
    h_.CountHomes(near_);
    h_.stats.aura_tests += static_cast<int64_t>(near_.size());
  }

  double ProjectReach() const { return margins_.project * step_; }

  // R11, `reach`: impulses of the script are known as far ahead as an aura's bound must reach.
  void AnnounceKicks() {
    if (!reach_) return;
    const Tick last = h_.tick + margins_.horizon + k_;
    if (announced_ == 0) announced_ = h_.tick;
    for (; announced_ < last; ++announced_) {
      std::vector<Input> inputs;
      ScriptedInputs(h_.world, announced_ + 1, &inputs);
      for (const Input& i : inputs) {
        if (i.kind == Input::Kind::kImpulse || i.kind == Input::Kind::kVelocity) kicks_.emplace(i.body, i);
      }
    }
    std::erase_if(kicks_, [this](const auto& e) { return e.second.tick <= h_.tick; });
  }

  // ------------------------------------------------------------------------------------------------ decision

  const BodyView OwnView(BodyId id) const {
    auto it = waiting_.find(id);
    return it == waiting_.end() ? h_.engine->View(id) : it->second;
  }

  // Own bodies, waiting spawns included, whose sphere box comes within `gap` of the box.
  void OwnNear(const Box& box, double gap, std::vector<BodyId>* out) const {
    std::vector<BodyId> hits;
    h_.engine->Query(box.Inflated(gap + h_.engine->MaxRadius()), &hits);
    for (BodyId id : hits) {
      if (Gap(SphereBox(h_.engine->View(id)), box) <= gap) out->push_back(id);
    }
    for (const auto& [id, view] : waiting_) {
      if (Gap(SphereBox(view), box) <= gap) out->push_back(id);
    }
  }

  // Everything of others that this region knows: their auras in state n-k, and its own departures, known at once (R1),
  // in the newest state that their shadow has.
  void FindForeign() {
    foreign_.clear();
    for (const auto& [id, s] : shadows_) {
      const auto& state = s.states[std::min<size_t>(h_.tick - s.sent, s.states.size() - 1)];
      foreign_.push_back({id, s.owner, SphereBox(state.view), false});
    }
    for (RegionId peer : h_.peers) {
      for (const auto& [id, a] : remote_[peer]) {
        if (!h_.held.contains(id) && !shadows_.contains(id)) foreign_.push_back({id, a.owner, Widen(a.box), false});
      }
    }
    std::sort(foreign_.begin(), foreign_.end(), [](const Node& x, const Node& y) {
      return x.box.min.x() != y.box.min.x() ? x.box.min.x() < y.box.min.x() : x.id < y.id;
    });
    h_.stats.aura_tests += static_cast<int64_t>(foreign_.size());
  }

  void Detect() {
    leaving_.clear();
    FindForeign();
    moved_.clear();
    SetBounds();
    AuraCollision();
    BoundaryTraverse();
  }

  // How far everything reaches. `tolerance`: as far as the speed tolerance allows, everything alike.
  void SetBounds() {
    same_ = {margins_.predict * step_ / 2, margins_.give_back * step_ / 2, 0, 0};
    most_push_ = same_.push;
    most_give_ = same_.give;
    for (Node& f : foreign_) {
      f.push = same_.push;
      f.give = same_.give;
    }
    if (!reach_) return;
    bounds_.clear();
    for (BodyId id : near_) bounds_[id];
    for (const auto& [id, view] : waiting_) bounds_[id];
    std::vector<BodyId> hits;
    for (const Node& f : foreign_) OwnNear(f.box, margins_.give_back * step_, &hits);
    for (RegionId peer : h_.peers) {
      for (const auto& [y, a] : away_[peer]) {
        if (a.owner != h_.self) OwnNear(Widen(a.box), ProjectReach(), &hits);
      }
    }
    for (BodyId id : hits) bounds_[id];
    ComputeReach();
  }

  double KickEnergy(BodyId id, const BodyView& v) const {
    double speed = v.asleep ? 0 : v.velocity.norm(), energy = v.energy;
    auto add = [&](const Input& i) {
      if (i.kind == Input::Kind::kImpulse) speed += i.linear.norm() / v.mass;
      if (i.kind == Input::Kind::kVelocity) speed = std::max(speed, i.linear.norm());
      // No body of mass m inside a sphere of radius r has an inertia of more than m r^2.
      const double spin =
          i.kind == Input::Kind::kImpulse ? i.angular.norm() : i.angular.norm() * v.mass * v.radius * v.radius;
      energy = std::max(energy, 0.5 * v.mass * speed * speed) +
               (i.kind == Input::Kind::kVelocity ? 0.5 * spin * i.angular.norm() : 0);
    };
    const auto [begin, end] = kicks_.equal_range(id);
    for (auto it = begin; it != end; ++it) add(it->second);
    for (const Input& i : h_.pending) {
      if (i.body == id && i.kind != Input::Kind::kSpawn) add(i);
    }
    return energy;
  }

  // R12. Foreign states are k ticks old: they move alone until now, then everything together; H - k ticks on is what AC
  // looks at, H + k what BT looks at and what an aura says.
  void ComputeReach() {
    const Environment& e = h_.world.environment;
    const ReachLimits limits{h_.world.tolerances.speed, h_.world.exchange.recovery, e.gravity.norm(), e.dt()};
    std::vector<ReachNode> nodes;
    std::vector<double> energies;
    std::map<std::pair<RegionId, BodyId>, int> groups;
    for (const Node& f : foreign_) {
      ReachNode n;
      n.id = f.id;
      n.box = f.box;
      const Aura aura = AuraOf(f.id);
      n.mass = std::max(1e-9, static_cast<double>(aura.mass));
      auto [it, fresh] = groups.emplace(std::pair{f.owner, aura.group}, static_cast<int>(energies.size()));
      if (fresh) energies.push_back(0);
      energies[it->second] = std::max(energies[it->second], static_cast<double>(aura.energy));
      n.group = it->second;
      nodes.push_back(n);
    }
    PropagateReach(nodes, &energies, {}, k_, limits);
    const size_t foreign = nodes.size();
    absl::flat_hash_map<BodyId, int> index;
    std::vector<BodyId> ids;
    for (const auto& [id, bound] : bounds_) ids.push_back(id);
    std::sort(ids.begin(), ids.end());
    for (BodyId id : ids) {
      const BodyView v = OwnView(id);
      index[id] = static_cast<int>(nodes.size());
      nodes.push_back({id, SphereBox(v), v.mass, static_cast<int>(energies.size()), 0});
      energies.push_back(KickEnergy(id, v));
    }
    std::vector<std::pair<int, int>> joined;
    std::vector<BodyId> partners;
    for (BodyId id : ids) {
      partners.clear();
      if (h_.engine->Contains(id)) h_.engine->Jointed(id, &partners);
      for (BodyId other : partners) {
        if (auto it = index.find(other); it != index.end()) joined.emplace_back(index[id], it->second);
      }
    }
    PropagateReach(nodes, &energies, joined, margins_.horizon - k_, limits);
    most_push_ = most_give_ = 0;
    for (size_t i = 0; i < nodes.size(); ++i) {
      (i < foreign ? foreign_[i].push : bounds_[nodes[i].id].push) = nodes[i].distance;
      if (i >= foreign) most_push_ = std::max(most_push_, nodes[i].distance);
    }
    PropagateReach(nodes, &energies, joined, 2 * k_, limits);
    std::vector<BodyId> name(energies.size(), 0);
    for (size_t i = 0; i < nodes.size(); ++i) {
      (i < foreign ? foreign_[i].give : bounds_[nodes[i].id].give) = nodes[i].distance;
      if (i < foreign) continue;
      most_give_ = std::max(most_give_, nodes[i].distance);
      if (name[nodes[i].group] == 0) name[nodes[i].group] = nodes[i].id;
      bounds_[nodes[i].id].group = name[nodes[i].group];
      bounds_[nodes[i].id].energy = energies[nodes[i].group];
    }
  }

  // What is known of a foreign body's bound.
  Aura AuraOf(BodyId id) const {
    if (auto s = shadows_.find(id); s != shadows_.end()) {
      const auto& states = s->second.states;
      return MakeAura(id, states[std::min<size_t>(h_.tick - s->second.sent, states.size() - 1)].view, s->second.owner);
    }
    for (const auto& [peer, auras] : remote_) {
      if (auto a = auras.find(id); a != auras.end()) return a->second;
    }
    AUREOLE_CHECK(false, "no aura of body %llu", static_cast<unsigned long long>(id));
  }

  // The bound of an own body. `grown` is set when it had none: then all must be computed again, with it.
  Bound BoundOf(BodyId id, bool* grown) {
    if (!reach_) return same_;
    auto [it, fresh] = bounds_.try_emplace(id);
    *grown |= fresh;
    return it->second;
  }

  // The paper's AC (Algorithm 1) by R3 and R4: components over everything that may meet, reached from what is foreign;
  // all own members go straight to the best rank among the owners.
  void AuraCollision() {
    std::vector<Node> nodes;
    UnionFind sets;
    while (!FindComponents(&nodes, &sets)) ComputeReach();
    std::map<int, std::vector<int>> components;
    for (int i = 0; i < sets.size(); ++i) components[sets.Find(i)].push_back(i);
    for (const auto& [representative, members] : components) Push(nodes, members);
  }

  // False when bodies came up whose reach is not known yet.
  bool FindComponents(std::vector<Node>* found, UnionFind* sets) {
    std::vector<Node>& nodes = *found;
    nodes = foreign_;
    sets->Reset(static_cast<int>(nodes.size()));
    double most = 0;
    for (const Node& n : nodes) most = std::max(most, n.push);
    for (size_t i = 0; i < nodes.size(); ++i) {
      const double far = nodes[i].push + most;
      for (size_t j = i + 1; j < nodes.size() && nodes[j].box.min.x() <= nodes[i].box.max.x() + far; ++j) {
        if (Gap(nodes[i].box, nodes[j].box) <= nodes[i].push + nodes[j].push) {
          sets->Unite(static_cast<int>(i), static_cast<int>(j));
        }
      }
    }
    bool grown = false;
    absl::flat_hash_map<BodyId, int> index;
    std::vector<BodyId> near;
    for (size_t i = 0; i < nodes.size(); ++i) {
      const Node n = nodes[i];
      near.clear();
      if (reach_ && n.own) {  // whoever may strike a member must be known
        OwnNear(n.box, 2 * (margins_.horizon - k_) * step_, &near);
        for (BodyId id : near) BoundOf(id, &grown);
        near.clear();
      }
      OwnNear(n.box, n.push + most_push_, &near);
      const size_t by_gap = near.size();
      if (n.own && h_.engine->Contains(n.id)) h_.engine->Jointed(n.id, &near);
      for (size_t q = 0; q < near.size(); ++q) {
        const BodyId id = near[q];
        const Box box = SphereBox(OwnView(id));
        const Bound bound = BoundOf(id, &grown);
        if (q < by_gap && Gap(box, n.box) > n.push + bound.push) continue;
        auto [it, fresh] = index.emplace(id, static_cast<int>(nodes.size()));
        if (fresh) {
          nodes.push_back({id, h_.self, box, true, bound.push, bound.give});
          sets->Add();
        }
        sets->Unite(static_cast<int>(i), it->second);
      }
    }
    return !grown;
  }

  void Push(const std::vector<Node>& nodes, const std::vector<int>& members) {
    RegionId best = nodes[members.front()].owner;
    std::set<RegionId> owners;
    std::vector<BodyId> ids;
    for (int i : members) {
      owners.insert(nodes[i].owner);
      if (h_.world.layout.rank(nodes[i].owner) < h_.world.layout.rank(best)) best = nodes[i].owner;
      if (nodes[i].own) ids.push_back(nodes[i].id);
    }
    if (ids.empty()) return;
    h_.stats.longest_chain = std::max(h_.stats.longest_chain, static_cast<int64_t>(owners.size()));
    h_.stats.largest_component = std::max(h_.stats.largest_component, static_cast<int64_t>(members.size()));
    if (best != h_.self) Send(std::move(ids), best, TransferCause::kAuraCollision);
  }

  // The paper's BT (Algorithm 2) by R6: an island goes home.
  void BoundaryTraverse() {
    std::vector<BodyId> seeds;
    for (BodyId id : near_) {
      if (h_.engine->Contains(id) && h_.rect.Gap(SphereBox(h_.engine->View(id))) > 0) seeds.push_back(id);
    }
    for (const auto& [id, view] : waiting_) {
      if (h_.rect.Gap(SphereBox(view)) > 0) seeds.push_back(id);
    }
    absl::flat_hash_map<BodyId, bool> verdict;  // id -> its component may return
    for (BodyId seed : seeds) {
      if (!h_.held.contains(seed) || verdict.contains(seed)) continue;
      std::vector<BodyId> island{seed};
      const bool returns = IslandQuery(&island, &verdict);
      for (BodyId id : island) verdict[id] = returns;
      if (!returns) continue;
      std::sort(island.begin(), island.end());
      std::vector<std::pair<RegionId, double>> mass;
      for (BodyId id : island) {
        const BodyView v = OwnView(id);
        AddMass(&mass, h_.world.layout.Home(v.centre), v.mass);
      }
      const RegionId home = Heaviest(h_.world.layout, mass);
      if (home != h_.self) Send(std::move(island), home, TransferCause::kBoundaryTraverse);
    }
  }

  // Grows `island` over D_ret until it is complete or something forbids its return. Components that were found to stay
  // are not walked again.
  bool IslandQuery(std::vector<BodyId>* island, absl::flat_hash_map<BodyId, bool>* verdict) {
    double most = 0;
    for (const Node& f : foreign_) most = std::max(most, f.give);
    std::vector<BodyId> near;
    std::set<BodyId> seen(island->begin(), island->end());
    for (size_t i = 0; i < island->size(); ++i) {
      const BodyId id = (*island)[i];
      const Box box = SphereBox(OwnView(id));
      if (h_.rect.Gap(box) <= 0 || h_.tick - h_.held.at(id).arrived < h_.world.exchange.Dwell()) return false;
      bool unknown = false;
      const double give = BoundOf(id, &unknown).give;
      if (unknown) return false;  // it stays until its reach is known
      for (const Node& f : foreign_) {
        if (f.box.min.x() > box.max.x() + give + most) break;
        if (Gap(f.box, box) <= give + f.give) return false;
      }
      near.clear();
      OwnNear(box, give + most_give_, &near);
      const size_t by_gap = near.size();
      if (h_.engine->Contains(id)) h_.engine->Jointed(id, &near);
      for (size_t q = 0; q < near.size(); ++q) {
        if (q < by_gap && Gap(SphereBox(OwnView(near[q])), box) > give + BoundOf(near[q], &unknown).give) continue;
        if (unknown) return false;
        auto it = verdict->find(near[q]);
        if (it != verdict->end() && !it->second) return false;
        if (seen.insert(near[q]).second) island->push_back(near[q]);
      }
    }
    // Whatever left in this tick is foreign now, and near it is no place for an island.
    for (BodyId id : *island) {
      const Box box = SphereBox(OwnView(id));
      for (const Box& m : moved_) {
        if (Gap(m, box) <= margins_.give_back * step_) return false;
      }
    }
    return true;
  }

  // ------------------------------------------------------------------------------------------------ transfers

  void Send(std::vector<BodyId> ids, RegionId to, TransferCause cause) {
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
      s.group = (groups_ * h_.world.layout.size()) + h_.self;
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

  // `last`: the view of a body that is not there (not yet, or no more).
  static Shadow::State StateOf(const Engine& engine, BodyId id, const BodyView& last) {
    Shadow::State s;
    s.exists = engine.Contains(id);
    s.view = s.exists ? engine.View(id) : last;
    s.box = s.view.box;
    if (s.exists) s.hash = engine.Hash(id);
    return s;
  }

  // Steps the cluster through the k-1 ticks of its flight, on its own, with the inputs of these ticks.
  void FastForward(Transfer* t) {
    if (k_ == 1) return;
    if (!t->state.empty()) {
      const absl::Status s = scratch_->Restore(t->state);
      AUREOLE_CHECK(s.ok(), "own state of body %llu: %s", static_cast<unsigned long long>(t->ids[0]),
                    std::string(s.message()).c_str());
    }
    for (Tick n = now(); n < now() + k_ - 1; ++n) {
      std::vector<Input> inputs;
      ScriptedInputs(h_.world, n, &inputs);
      std::erase_if(inputs, [](const Input& i) { return i.kind == Input::Kind::kSpawn; });
      const auto due = std::find_if(t->pending.begin(), t->pending.end(), [n](const Input& i) { return i.tick > n; });
      inputs.insert(inputs.end(), t->pending.begin(), due);
      t->pending.erase(t->pending.begin(), due);
      std::sort(inputs.begin(), inputs.end());
      for (const Input& i : inputs) {
        if (i.kind == Input::Kind::kSpawn || scratch_->Contains(i.body)) scratch_->Apply(i);
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

  // A body that was removed in flight does not arrive.
  void ForgetRemoved(Transfer* t) const {
    size_t kept = 0;
    for (size_t i = 0; i < t->ids.size(); ++i) {
      const BodyId id = t->ids[i];
      const bool spawns = std::any_of(t->pending.begin(), t->pending.end(), [id](const Input& in) {
        return in.kind == Input::Kind::kSpawn && in.body == id;
      });
      if (!spawns && !scratch_->Contains(id)) continue;
      t->ids[kept] = id;
      t->epochs[kept++] = t->epochs[i];
    }
    t->ids.resize(kept);
    t->epochs.resize(kept);
  }

  // ------------------------------------------------------------------------------------------------ projection

  using Auras = std::map<BodyId, Aura>;

  Aura MakeAura(BodyId id, const BodyView& v, RegionId owner) const {
    Aura a;
    a.id = id;
    a.box = RoundOutward(SphereBox(v));
    a.owner = owner;
    if (!reach_) return a;
    a.group = id;
    double energy = v.energy;
    if (auto s = shadows_.find(id); s != shadows_.end()) {
      a.group = s->second.bound.group;
      energy = std::max(energy, s->second.bound.energy);
    } else if (auto b = bounds_.find(id); b != bounds_.end()) {
      a.group = b->second.group;
      energy = b->second.energy;
    }
    a.energy = std::nextafter(static_cast<float>(energy), std::numeric_limits<float>::infinity());
    if (energy == 0) a.energy = 0;
    a.mass = std::nextafter(static_cast<float>(v.mass), 0.0f);
    return a;
  }

  // The paper's BNU (Algorithm 6). R9: whom to tell is computed afresh as a set each tick; OBC, OBU and OBE (Algorithms
  // 3 to 5) are its differences from the set before.
  void BoundaryNetworkUpdate(std::vector<Frame>* out) {
    std::map<RegionId, Auras> next;
    std::map<BodyId, Away> away;
    Project(&next, &away);
    h_.stats.auras_told = 0;
    for (RegionId peer : h_.peers) {
      Frame f;
      f.from = h_.self;
      f.to = {peer};
      f.tick = h_.tick;
      Difference(told_[peer], next[peer], &f.auras, &f.gone);
      Difference(told_away_, away, &f.away, &f.away_gone);
      if (auto it = leaving_.find(peer); it != leaving_.end()) f.transfers = std::move(it->second);
      h_.stats.auras_sent += static_cast<int64_t>(f.auras.size());
      h_.stats.auras_told += static_cast<int64_t>(next[peer].size());
      told_[peer] = std::move(next[peer]);
      out->push_back(std::move(f));
    }
    leaving_.clear();
    told_away_ = std::move(away);
  }

  template <class T>
  static void Difference(const std::map<BodyId, T>& before, const std::map<BodyId, T>& after, std::vector<T>* changed,
                         std::vector<BodyId>* gone) {
    auto b = before.begin();
    for (const auto& [id, value] : after) {
      for (; b != before.end() && b->first < id; ++b) gone->push_back(b->first);  // OBE
      if (b == before.end() || b->first != id) {
        changed->push_back(value);  // OBC
      } else {
        if (!(b->second == value)) changed->push_back(value);  // OBU
        ++b;
      }
    }
    for (; b != before.end(); ++b) gone->push_back(b->first);
  }

  void Project(std::map<RegionId, Auras>* next, std::map<BodyId, Away>* away) {
    const double reach = ProjectReach();
    near_.clear();
    h_.engine->CollectOutside(h_.rect, reach + h_.engine->MaxRadius(), &near_);
    for (BodyId id : near_) ProjectToRegions(id, h_.engine->View(id), h_.self, next, away);
    for (const auto& [id, view] : waiting_) ProjectToRegions(id, view, h_.self, next, away);
    for (const auto& [id, s] : shadows_) {
      if (h_.tick - s.sent >= k_) continue;
      ProjectToRegions(id, s.states[h_.tick - s.sent].view, s.owner, next, away);
    }
    std::vector<BodyId> hits;
    for (RegionId peer : h_.peers) {
      for (const auto& [y, a] : away_[peer]) {
        if (a.owner == h_.self || a.owner == kNoRegion) continue;
        const Box box = Widen(a.box);
        hits.clear();
        OwnNear(box, reach, &hits);
        Auras& told = (*next)[a.owner];
        for (BodyId id : hits) told.try_emplace(id, MakeAura(id, OwnView(id), h_.self));
        for (const auto& [id, s] : shadows_) {
          if (h_.tick - s.sent >= k_) continue;
          const BodyView& v = s.states[h_.tick - s.sent].view;
          if (Gap(SphereBox(v), box) <= reach) told.try_emplace(id, MakeAura(id, v, s.owner));
        }
      }
    }
  }

  void ProjectToRegions(BodyId id, const BodyView& v, RegionId owner, std::map<RegionId, Auras>* next,
                        std::map<BodyId, Away>* away) {
    const Box box = SphereBox(v);
    const double reach = ProjectReach();
    for (RegionId peer : h_.peers) {
      if (h_.world.layout.rect(peer).Gap(box) <= reach) (*next)[peer].emplace(id, MakeAura(id, v, owner));
    }
    if (!h_.world.layout.rect(owner).Encloses(box, 0)) (*away)[id] = {id, owner, RoundOutward(box)};
  }

  Holdings& h_;
  const int k_;
  const Margins margins_;
  double step_ = 0;  // metres that a body can move in a tick
  bool reach_ = false;
  bool started_ = false;
  Phase phase_ = Phase::kBegin;
  std::unique_ptr<Engine> scratch_;
  int64_t groups_ = 0;

  std::map<RegionId, std::map<BodyId, Aura>> remote_;  // of state n-k, by who projects
  std::map<RegionId, std::map<BodyId, Away>> away_;
  absl::flat_hash_map<BodyId, Shadow> shadows_;  // sent less than 2k ticks ago
  std::map<BodyId, BodyView> waiting_;           // owned spawns that have not taken effect
  std::vector<Node> foreign_;                    // by min.x
  std::vector<Box> moved_;                       // of what was sent in this tick
  Bound same_;                                   // of every body, in the `tolerance` policy
  absl::flat_hash_map<BodyId, Bound> bounds_;    // of own bodies, in the `reach` policy
  double most_push_ = 0, most_give_ = 0;         // over own bodies
  std::multimap<BodyId, Input> kicks_;           // scripted impulses that are announced
  Tick announced_ = 0;                           // up to this tick
  std::vector<BodyId> near_;
  std::map<RegionId, std::vector<Transfer>> leaving_;
  std::map<RegionId, Auras> told_;
  std::map<BodyId, Away> told_away_;
};

}  // namespace

std::unique_ptr<Protocol> MakeDelayedExchange(Holdings& holdings) {
  return std::make_unique<DelayedExchange>(holdings);
}

}  // namespace aureole
