// The synchronous exchange, k = 0 (PROTOCOL.md section 10, form A): inside one tick, on states that stand still, boxes
// -> graph -> transfers. Nothing is predicted, so there is no speed tolerance, and three exchanges are enough for any
// layout.
//
// Boxes go only between regions that have opened to each other, a little before a body of one reaches the other. A body
// that comes faster, or from nowhere, is told late: with its owner's graph, which goes to all; then all make their
// graphs again. So the messages of a region grow with its neighbours and with the square root of all regions.
#include <algorithm>
#include <iterator>
#include <map>
#include <set>

#include <absl/container/flat_hash_map.h>
#include <absl/container/flat_hash_set.h>

#include "server/core/allgather.h"
#include "server/core/check.h"
#include "server/core/holdings.h"
#include "server/core/union_find.h"

namespace aureole {
namespace {

// Boxes are tested against regions with this to spare, so that the two comparisons of R15 cannot disagree by rounding;
// metres.
constexpr double kSpare = 1e-3;
// Regions open to each other when a body comes this near, and close when none was for so long: metres, ticks. That
// decides how often boxes are told late, and nothing else. Half a metre is a tick at 32 m/s.
constexpr double kOpenAhead = 0.5;
constexpr Tick kStayOpen = 64;
// Islands go home a few at a time, so that no tick is long when a new layout gives many a new home: so many bodies in
// a tick, or one island.
constexpr int64_t kMostReturned = 512;

class SyncExchange final : public Protocol {
 public:
  SyncExchange(Holdings& holdings, bool joins)
      : h_(holdings),
        gather_(h_.division.now().members, h_.self),
        open_(h_.peers.size()),
        phase_(joins ? Phase::kJoin : BetweenTicks()) {}

  Phase phase() const override { return phase_; }

  bool Ready() const override {
    if (phase_ == Phase::kJoin) return Sponsor() != kNoRegion;
    if (phase_ == Phase::kLeft) return false;
    for (RegionId p : h_.peers) {
      if (!HasFrame(p)) return false;
    }
    return true;
  }

  void Missing(std::vector<RegionId>* out) const override {
    if (phase_ == Phase::kJoin && !Ready()) *out = h_.peers;  // any of them may be the sponsor
    if (phase_ == Phase::kJoin) return;
    for (RegionId p : h_.peers) {
      if (!HasFrame(p)) out->push_back(p);
    }
  }

  void Advance(std::vector<Frame>* out) override {
    switch (phase_) {
      case Phase::kJoin:
        return Join();
      case Phase::kLeft:
        return;
      case Phase::kBegin:
        return Begin(out);
      case Phase::kGraph:
        TakeBoxes();
        return SendGraph(kGraphs, out);
      case Phase::kRelay:
        return PassOn(out);
      case Phase::kDecide:
        return Decide(out);
      case Phase::kArrive:
        return TakeArrivals();
      case Phase::kStep:
        h_.MeasureSlack(now());
        h_.engine->Step(now());
        ++h_.tick;
        phase_ = BetweenTicks();
    }
  }

  bool MaySend(RegionId peer, int round, const Division::State& division) const override {
    const Allgather gather = &division == &h_.division.now() ? gather_ : Allgather(division.members, h_.self);
    if (round == kGraphs || round == kGraphsAgain) return Contains(gather.row, peer);
    if (round == kGraphsOn || round == kGraphsAgainOn) return Contains(gather.sources, peer);
    return round == kBoxes || round == kTransfers || (round == kWelcome && phase_ == Phase::kJoin);
  }

  void ObserveInFlight(std::vector<BodyRecord>*) const override {}
  void AppendAuras(size_t most, std::vector<WireBox>* out) const override {
    absl::flat_hash_set<BodyId> seen;
    for (const auto& [peer, told] : told_) {
      for (const auto& [id, box] : told) {
        if (seen.size() < most && seen.insert(id).second) out->push_back(box);
      }
    }
  }

  void Save(Writer& a) const override { const_cast<SyncExchange*>(this)->Visit(a); }
  void Load(Reader& a) override { Visit(a); }

 private:
  // What outlives a tick.
  template <class Archive>
  void Visit(Archive& a) {
    a(open_, told_, remote_);
  }

  struct Foreign {
    BodyId id;
    RegionId owner;
    Box box;
  };
  // Whether boxes are exchanged with a peer: while either side wants it.
  struct Opening {
    bool by_us = false, by_them = false;
    Tick last_near = -kStayOpen;  // when a body of ours was near the peer
    bool Now() const { return by_us || by_them; }

    template <class Archive>
    void Visit(Archive& a) {
      a(by_us, by_them, last_near);
    }
  };
  // A contact component of own bodies; `wire` is what the others get to know of it.
  struct Component {
    Fragment wire;
    std::vector<BodyId> members;  // ascending
  };

  Tick now() const { return h_.tick + 1; }

  // The round of the frame that the current phase needs from this peer, -1 for none.
  int NeededRound(RegionId peer) const {
    switch (phase_) {
      case Phase::kGraph:
        return open_[PeerIndex(peer)].Now() ? kBoxes : -1;
      case Phase::kRelay:
        return Contains(gather_.row, peer) ? round_ : -1;
      case Phase::kDecide:
        return Contains(gather_.sources, peer) ? round_ + 1 : -1;
      case Phase::kArrive:
        return senders_.contains(peer) ? kTransfers : -1;
      default:
        return -1;
    }
  }
  bool HasFrame(RegionId peer) const {
    const int round = NeededRound(peer);
    if (round < 0) return true;
    const Frame* f = h_.inboxes.at(peer).Front();
    if (f == nullptr) return false;
    AUREOLE_CHECK(f->tick == now() && f->round == round, "region %d sent (%lld, %d) where (%lld, %d) was due", peer,
                  static_cast<long long>(f->tick), f->round, static_cast<long long>(now()), round);
    return true;
  }

  static bool Contains(const std::vector<RegionId>& list, RegionId r) {
    return std::binary_search(list.begin(), list.end(), r);
  }
  size_t PeerIndex(RegionId peer) const {
    return static_cast<size_t>(std::lower_bound(h_.peers.begin(), h_.peers.end(), peer) - h_.peers.begin());
  }

  // What came long before its tick, in a region that repeats what it had done, was not held against its layout then.
  Frame Pop(RegionId peer) {
    Frame f = h_.inboxes.at(peer).Pop();
    const absl::Status s = CheckRegions(f, h_.division.now());
    AUREOLE_CHECK(s.ok(), "region %d sent what is not of tick %lld: %s", peer, static_cast<long long>(now()),
                  std::string(s.message()).c_str());
    return f;
  }

  Frame MakeFrame(std::vector<RegionId> to, int round) const {
    Frame f;
    f.from = h_.self;
    f.to = std::move(to);
    f.tick = now();
    f.round = round;
    return f;
  }

  // In force in the next tick.
  const Division::State& Next() const { return *h_.division.At(now(), h_.tick); }

  Phase BetweenTicks() const { return Next().IsMember(h_.self) ? Phase::kBegin : Phase::kLeft; }

  // Of a region that joins: who has sent the welcome; kNoRegion: nobody yet.
  RegionId Sponsor() const {
    for (RegionId p : h_.peers) {
      const Frame* f = h_.inboxes.at(p).Front();
      if (f != nullptr && f->round == kWelcome) return p;
    }
    return kNoRegion;
  }

  void Join() {
    const RegionId sponsor = Sponsor();
    const Frame f = h_.inboxes.at(sponsor).Pop();
    Reader reader(f.welcome);
    reader(h_.division);
    h_.live.Learn(reader);
    AUREOLE_CHECK(reader.done(), "region %d cannot read the welcome of region %d", h_.self, sponsor);
    h_.tick = f.tick;
    OpenToChanged(nullptr);
    phase_ = Phase::kBegin;
  }

  void AdoptLayout(std::vector<Frame>* out) {
    if (h_.division.next_at() != now()) return;
    const Division::State before = h_.division.now();
    h_.division.Adopt(now());
    const std::vector<RegionId> peers = h_.peers;
    const std::vector<Opening> open = std::move(open_);
    h_.FollowDivision();
    gather_ = Allgather(h_.division.now().members, h_.self);
    open_.assign(h_.peers.size(), {});
    for (size_t i = 0; i < peers.size(); ++i) {
      if (Contains(h_.peers, peers[i])) {
        open_[PeerIndex(peers[i])] = open[i];
        continue;
      }
      told_.erase(peers[i]);
      next_.erase(peers[i]);
      remote_.erase(peers[i]);
    }
    OpenToChanged(&before);
    SendWelcome(before, out);
    // Who has a new home because of the layout has crossed nothing.
    const int64_t crossings = h_.stats.home_crossings;
    near_.clear();
    h_.engine->CollectOutside(h_.rect, kOpenAhead, &near_);
    h_.CountHomes(near_);
    h_.stats.home_crossings = crossings;
  }

  // Where either rectangle is new, much may be near at once: such pairs are open from the start, and close as others
  // do. A region that joins (`before` is null) is new to all.
  void OpenToChanged(const Division::State* before) {
    const auto changed = [&](RegionId r) {
      return before == nullptr || !before->IsMember(r) || before->layout.rect(r) != h_.layout().rect(r);
    };
    for (size_t p = 0; p < h_.peers.size(); ++p) {
      if (changed(h_.self) || changed(h_.peers[p])) open_[p] = {true, true, now()};
    }
  }

  // The lowest of those that were there before and stay tells those that join.
  void SendWelcome(const Division::State& before, std::vector<Frame>* out) {
    std::vector<RegionId> stay, join;
    for (RegionId r : h_.division.now().members) (before.IsMember(r) ? stay : join).push_back(r);
    if (join.empty() || stay.front() != h_.self) return;
    Frame f = MakeFrame(std::move(join), kWelcome);
    f.tick = h_.tick;
    Writer writer(&f.welcome);
    writer(h_.division);
    h_.live.Teach(writer);
    out->push_back(std::move(f));
  }

  // R13: everything with effect in this tick happens before its exchange. Then R14.
  void Begin(std::vector<Frame>* out) {
    AdoptLayout(out);
    inputs_.clear();
    h_.AppendInputs(now(), &inputs_);
    h_.live.ForgetBefore(now() + 1);
    for (const Input& i : inputs_) {
      const bool elsewhere = i.kind == Input::Kind::kSpawn && h_.layout().Home(i.spawn->position) != h_.self;
      if (!elsewhere) h_.Apply(i);
    }
    near_.clear();
    h_.engine->CollectOutside(h_.rect, kOpenAhead, &near_);
    h_.CountHomes(near_);
    BoundaryNetworkUpdate(out);
    mine_.inputs = h_.live.TakeOffered();
    mine_.applied = h_.live.TakeApplied();
    mine_.emptied = Leaving() && h_.held.empty() && !h_.division.IsEmptied(h_.self);
    phase_ = Phase::kGraph;
    if (!h_.peers.empty()) return;
    graphs_.assign(1, mine_);
    HearInputs();
    phase_ = Phase::kStep;
  }

  // The paper's BNU (Algorithm 6), built once per tick (P52). R14: a body is told to every region whose closed
  // rectangle its exact box touches. OBC, OBU and OBE (Algorithms 3 to 5) are the three outcomes of comparing what a
  // peer holds with what it must hold: created, updated, destroyed; recomputed as a set each tick (P13).
  void BoundaryNetworkUpdate(std::vector<Frame>* out) {
    told_ids_.clear();
    for (RegionId peer : h_.peers) next_[peer].clear();
    for (BodyId id : near_) {
      const Box box = h_.engine->View(id).box;
      const WireBox wire = RoundOutward(box);
      bool told = false;
      for (size_t p = 0; p < h_.peers.size(); ++p) {
        const double gap = h_.layout().rect(h_.peers[p]).Gap(box);
        if (gap > kOpenAhead) continue;
        open_[p].last_near = now();
        if (gap > kSpare) continue;
        next_[h_.peers[p]].push_back({id, wire});
        told = true;
      }
      if (told) told_ids_.push_back(id);
    }
    h_.stats.aura_tests += static_cast<int64_t>(near_.size());
    h_.stats.auras_told = 0;
    mine_ = {};
    mine_.of = h_.self;
    for (size_t p = 0; p < h_.peers.size(); ++p) TellBoxes(h_.peers[p], open_[p], out);
  }

  void TellBoxes(RegionId peer, const Opening& opening, std::vector<Frame>* out) {
    Told& told = told_[peer];
    Told& next = next_[peer];
    Frame f = MakeFrame({peer}, kBoxes);
    Compare(told, next, &f);
    h_.stats.auras_sent += static_cast<int64_t>(f.auras.size());
    h_.stats.auras_told += static_cast<int64_t>(next.size());
    std::swap(told, next);
    const bool near = now() - opening.last_near < kStayOpen;
    if (near && !opening.by_us) mine_.opened.push_back(peer);
    if (!near && opening.by_us) mine_.closed.push_back(peer);
    if (opening.Now()) {
      out->push_back(std::move(f));
    } else {  // nothing was told before, so nothing is gone
      for (const Aura& a : f.auras) mine_.late.push_back({peer, a});
    }
  }

  using Told = std::vector<std::pair<BodyId, WireBox>>;  // ascending

  static void Compare(const Told& before, const Told& after, Frame* f) {
    auto b = before.begin();
    for (const auto& [id, box] : after) {
      for (; b != before.end() && b->first < id; ++b) DestroyAura(b->first, f);
      if (b != before.end() && b->first == id) {
        if (b->second != box) UpdateAura(id, box, f);
        ++b;
      } else {
        CreateAura(id, box, f);
      }
    }
    for (; b != before.end(); ++b) DestroyAura(b->first, f);
  }
  static void CreateAura(BodyId id, const WireBox& box, Frame* f) { UpdateAura(id, box, f); }
  static void UpdateAura(BodyId id, const WireBox& box, Frame* f) {
    Aura a;
    a.id = id;
    a.box = box;
    f->auras.push_back(a);
  }
  static void DestroyAura(BodyId id, Frame* f) { f->gone.push_back(id); }

  // R15, R16: which bodies of different owners meet, as far as this region was told; and its own components that others
  // may have to move.
  void SendGraph(int round, std::vector<Frame>* out) {
    SortForeign();
    mine_.edges.clear();
    mine_.fragments.clear();
    std::vector<BodyId> known = told_ids_;
    FindEdges(&mine_.edges, &known);
    std::sort(known.begin(), known.end());
    known.erase(std::unique(known.begin(), known.end()), known.end());
    FindComponents(known);
    for (const Component& c : components_) mine_.fragments.push_back(c.wire);
    graphs_.clear();
    if (!mine_.empty()) graphs_.push_back(mine_);
    round_ = round;
    if (!gather_.row.empty()) {
      Frame f = MakeFrame(gather_.row, round);
      f.graphs = graphs_;
      out->push_back(std::move(f));
    }
    phase_ = Phase::kRelay;
  }

  // The second hop: what the own row has to say, to one region of each other row.
  void PassOn(std::vector<Frame>* out) {
    for (RegionId peer : gather_.row) TakeGraphs(peer);
    if (!gather_.targets.empty()) {
      Frame f = MakeFrame(gather_.targets, round_ + 1);
      f.graphs = graphs_;
      std::sort(f.graphs.begin(), f.graphs.end(), [](const Graph& x, const Graph& y) { return x.of < y.of; });
      out->push_back(std::move(f));
    }
    phase_ = Phase::kDecide;
  }

  void TakeGraphs(RegionId peer) {
    Frame f = Pop(peer);
    graphs_.insert(graphs_.end(), std::make_move_iterator(f.graphs.begin()), std::make_move_iterator(f.graphs.end()));
  }

  void TakeBoxes() {
    for (RegionId peer : h_.peers) {
      if (!open_[PeerIndex(peer)].Now()) continue;
      Frame f = Pop(peer);
      auto& boxes = remote_[peer];
      for (BodyId id : f.gone) boxes.erase(id);
      for (const Aura& a : f.auras) boxes[a.id] = Widen(a.box);
    }
  }

  void SortForeign() {
    foreign_.clear();
    for (const auto& [peer, boxes] : remote_) {
      for (const auto& [id, box] : boxes) foreign_.push_back({id, peer, box});
    }
    std::sort(foreign_.begin(), foreign_.end(), [](const Foreign& x, const Foreign& y) {
      return x.box.min.x() != y.box.min.x() ? x.box.min.x() < y.box.min.x() : x.id < y.id;
    });
  }

  void FindEdges(std::vector<Edge>* edges, std::vector<BodyId>* touched) {
    std::vector<BodyId> hits;
    for (const Foreign& f : foreign_) {
      hits.clear();
      h_.engine->Query(f.box, &hits);
      for (BodyId own : hits) {
        AUREOLE_CHECK(own != f.id, "body %llu is owned by regions %d and %d", static_cast<unsigned long long>(own),
                      h_.self, f.owner);
        edges->push_back({std::min(own, f.id), std::max(own, f.id)});
        touched->push_back(own);
      }
    }
    // Introductions (R15): two foreign bodies that meet here, whose owners need not know of each other.
    for (size_t i = 0; i < foreign_.size(); ++i) {
      for (size_t j = i + 1; j < foreign_.size() && foreign_[j].box.min.x() <= foreign_[i].box.max.x(); ++j) {
        if (foreign_[i].owner == foreign_[j].owner || !Overlap(foreign_[i].box, foreign_[j].box)) continue;
        edges->push_back({std::min(foreign_[i].id, foreign_[j].id), std::max(foreign_[i].id, foreign_[j].id)});
      }
    }
    h_.stats.aura_tests += static_cast<int64_t>(foreign_.size());
    std::sort(edges->begin(), edges->end(),
              [](const Edge& x, const Edge& y) { return x.a != y.a ? x.a < y.a : x.b < y.b; });
    edges->erase(std::unique(edges->begin(), edges->end()), edges->end());
  }

  // The contact components (joints included) of own bodies that hold a known one.
  void FindComponents(const std::vector<BodyId>& known) {
    components_.clear();
    int64_t returned = 0;
    absl::flat_hash_set<BodyId> seen;
    std::vector<BodyId> reached;
    for (BodyId seed : known) {
      if (!seen.insert(seed).second) continue;
      Component c;
      c.members.push_back(seed);
      for (size_t i = 0; i < c.members.size(); ++i) {
        reached.clear();
        h_.engine->Query(h_.engine->View(c.members[i]).box, &reached);
        h_.engine->Jointed(c.members[i], &reached);
        for (BodyId id : reached) {
          if (seen.insert(id).second) c.members.push_back(id);
        }
      }
      std::sort(c.members.begin(), c.members.end());
      c.wire.id = c.members.front();
      c.wire.bodies = static_cast<uint32_t>(c.members.size());
      std::set_intersection(c.members.begin(), c.members.end(), known.begin(), known.end(),
                            std::back_inserter(c.wire.known));
      for (BodyId id : c.members) {
        const BodyView v = h_.engine->View(id);
        AddMass(&c.wire.mass_by_home, Stays(v) ? h_.self : h_.layout().Home(v.centre), v.mass);
      }
      if (returned < kMostReturned) c.wire.gives_back = BoundaryTraverse(c);
      if (c.wire.gives_back != kNoRegion) returned += c.wire.bodies;
      components_.push_back(std::move(c));
    }
  }

  // A body that has hardly left counts as at home: who sways over the border, or is struck across it, moves less often.
  bool Stays(const BodyView& v) const { return h_.rect.Gap(v.box) <= h_.world.exchange.home_slack; }

  // Without area, nothing is at home here, and what is here goes, whatever is near it.
  bool Leaving() const { return !h_.rect.HasArea(); }

  // The paper's BT (Algorithm 2), by R20: an island goes home when none of it meets this region, nothing that is
  // foreign or stays here is near, and it has been here for a while. Returns its new owner, or kNoRegion.
  RegionId BoundaryTraverse(const Component& c) const {
    if (!Leaving() && !MayReturn(c)) return kNoRegion;
    const RegionId home = Heaviest(h_.layout(), c.wire.mass_by_home);
    return home == h_.self ? kNoRegion : home;
  }

  bool MayReturn(const Component& c) const {
    for (BodyId id : c.members) {
      if (now() - h_.held.at(id).arrived < h_.world.exchange.Dwell()) return false;
      if (Stays(h_.engine->View(id))) return false;
    }
    const double gap = h_.world.exchange.return_gap;
    std::vector<BodyId> near;
    for (BodyId id : c.members) {
      const Box box = h_.engine->View(id).box;
      near.clear();
      h_.engine->Query(box.Inflated(gap), &near);
      for (BodyId other : near) {
        if (Stays(h_.engine->View(other))) return false;
      }
      for (const Foreign& f : foreign_) {
        if (f.box.min.x() > box.max.x() + gap) break;
        if (Gap(f.box, box) <= gap) return false;
      }
    }
    return true;
  }

  // R17, R19: all regions hold the same graphs, so all find the same components and the same owner for each.
  void Decide(std::vector<Frame>* out) {
    for (RegionId peer : gather_.sources) TakeGraphs(peer);
    std::sort(graphs_.begin(), graphs_.end(), [](const Graph& x, const Graph& y) { return x.of < y.of; });
    if (round_ == kGraphs && TakeLate()) {
      ++h_.stats.graphs_again;
      return SendGraph(kGraphsAgain, out);
    }
    OpenAndClose();
    HearInputs();
    std::map<RegionId, Frame> leaving;
    senders_.clear();
    GiveBackIslands(&leaving);
    AuraCollision(&leaving);
    for (auto& [to, frame] : leaving) out->push_back(std::move(frame));
    if (senders_.empty() && leaving.empty()) ++h_.stats.exchanges_ended_early;
    phase_ = senders_.empty() ? Phase::kStep : Phase::kArrive;
  }

  // Whether anybody told anybody late; what is for this region is taken.
  bool TakeLate() {
    bool any = false;
    for (const Graph& g : graphs_) {
      any |= !g.late.empty();
      for (const LateAura& l : g.late) {
        if (l.to == h_.self) remote_[g.of][l.aura.id] = Widen(l.aura.box);
      }
    }
    mine_.late.clear();
    return any;
  }

  // What all have offered takes effect in the next tick; what took effect in this one, all have said.
  void HearInputs() {
    for (const Graph& g : graphs_) h_.live.Heard(g.applied);
    h_.live.Settle(now());
    for (const Graph& g : graphs_) {
      if (g.emptied) h_.division.Emptied(g.of);
    }
    for (const Graph& g : graphs_) h_.live.Deliver(g.inputs, now() + 1, now() + 1, g.of == h_.self);
  }

  // Both ends read the same graphs, so both change at the same tick.
  void OpenAndClose() {
    for (const Graph& g : graphs_) {
      for (const std::vector<RegionId>* list : {&g.opened, &g.closed}) {
        for (RegionId r : *list) {
          if (g.of == h_.self) open_[PeerIndex(r)].by_us = list == &g.opened;
          if (r == h_.self) open_[PeerIndex(g.of)].by_them = list == &g.opened;
        }
      }
    }
  }

  struct Node {
    RegionId owner;
    const Fragment* fragment;
    size_t index;  // in its owner's graph
  };

  // The bodies that have an edge, over all graphs.
  absl::flat_hash_map<BodyId, int> EdgeBodies() const {
    absl::flat_hash_map<BodyId, int> bodies;
    for (const Graph& graph : graphs_) {
      for (const Edge& e : graph.edges) {
        bodies.emplace(e.a, -1);
        bodies.emplace(e.b, -1);
      }
    }
    return bodies;
  }

  // The paper's AC (Algorithm 1), by R17 and R19: every component of more than one owner goes whole to the region that
  // is home to most of its mass.
  void AuraCollision(std::map<RegionId, Frame>* leaving) {
    absl::flat_hash_map<BodyId, int> node_of = EdgeBodies();
    if (node_of.empty()) return;
    std::vector<Node> nodes;
    for (const Graph& graph : graphs_) {
      for (size_t i = 0; i < graph.fragments.size(); ++i) {
        bool linked = false;
        for (BodyId id : graph.fragments[i].known) {
          auto it = node_of.find(id);
          if (it == node_of.end()) continue;
          it->second = static_cast<int>(nodes.size());
          linked = true;
        }
        if (linked) nodes.push_back({graph.of, &graph.fragments[i], i});
      }
    }
    UnionFind sets(static_cast<int>(nodes.size()));
    for (const Graph& graph : graphs_) {
      for (const Edge& e : graph.edges) {
        const int a = node_of.at(e.a), b = node_of.at(e.b);
        AUREOLE_CHECK(a >= 0 && b >= 0, "no fragment holds body %llu of the edge that region %d saw",
                      static_cast<unsigned long long>(a < 0 ? e.a : e.b), graph.of);
        sets.Unite(a, b);
      }
    }
    std::map<int, std::vector<int>> clusters;  // by representative; nodes ascend by (owner, fragment)
    for (int i = 0; i < sets.size(); ++i) clusters[sets.Find(i)].push_back(i);
    for (const auto& [representative, members] : clusters) MoveCluster(nodes, members, leaving);
  }

  void MoveCluster(const std::vector<Node>& nodes, const std::vector<int>& members,
                   std::map<RegionId, Frame>* leaving) {
    std::vector<std::pair<RegionId, double>> mass;
    std::set<RegionId> owners;
    int64_t bodies = 0;
    for (int i : members) {
      const Fragment& f = *nodes[i].fragment;
      owners.insert(nodes[i].owner);
      bodies += f.bodies;
      for (const auto& [home, kg] : f.mass_by_home) AddMass(&mass, home, kg);
    }
    h_.stats.largest_component = std::max(h_.stats.largest_component, bodies);
    h_.stats.longest_chain = std::max(h_.stats.longest_chain, static_cast<int64_t>(owners.size()));
    const RegionId target = Heaviest(h_.layout(), mass);
    std::vector<BodyId> ids;
    for (int i : members) {
      if (nodes[i].owner == target) continue;
      if (target == h_.self) senders_.insert(nodes[i].owner);
      if (nodes[i].owner != h_.self) continue;
      const std::vector<BodyId>& more = components_[nodes[i].index].members;
      ids.insert(ids.end(), more.begin(), more.end());
    }
    if (!ids.empty()) Send(std::move(ids), target, TransferCause::kAuraCollision, leaving);
  }

  // Returns that were announced with the graph hold unless the component has an edge.
  void GiveBackIslands(std::map<RegionId, Frame>* leaving) {
    const absl::flat_hash_map<BodyId, int> linked = EdgeBodies();
    for (const Graph& graph : graphs_) {
      for (size_t i = 0; i < graph.fragments.size(); ++i) {
        const Fragment& f = graph.fragments[i];
        if (f.gives_back == kNoRegion) continue;
        if (std::any_of(f.known.begin(), f.known.end(), [&linked](BodyId id) { return linked.contains(id); })) continue;
        if (f.gives_back == h_.self) senders_.insert(graph.of);
        if (graph.of == h_.self) {
          const TransferCause cause = Leaving() ? TransferCause::kDrain : TransferCause::kBoundaryTraverse;
          Send(components_[i].members, f.gives_back, cause, leaving);
        }
      }
    }
  }

  void Send(std::vector<BodyId> ids, RegionId to, TransferCause cause, std::map<RegionId, Frame>* leaving) {
    std::sort(ids.begin(), ids.end());
    Transfer t = h_.Depart(std::move(ids), to, cause);
    t.state = h_.engine->Extract(t.ids);
    auto it = leaving->find(to);
    if (it == leaving->end()) it = leaving->emplace(to, MakeFrame({to}, kTransfers)).first;
    it->second.transfers.push_back(std::move(t));
  }

  void TakeArrivals() {
    for (RegionId peer : senders_) {
      const Frame f = Pop(peer);
      for (const Transfer& t : f.transfers) h_.Arrive(t, peer, now());
    }
    senders_.clear();
    phase_ = Phase::kStep;
  }

  Holdings& h_;
  Allgather gather_;
  std::vector<Opening> open_;  // parallel to the peers
  Phase phase_;
  std::vector<Input> inputs_;
  std::vector<BodyId> near_;                         // own bodies whose box may touch another region
  std::vector<BodyId> told_ids_;                     // of these, told to anybody; ascending
  absl::flat_hash_map<RegionId, Told> told_, next_;  // what each peer holds of us; what it must hold
  absl::flat_hash_map<RegionId, absl::flat_hash_map<BodyId, Box>> remote_;  // what each peer has told
  std::vector<Foreign> foreign_;                                            // all of that, by min.x
  std::vector<Component> components_;                                       // parallel to mine_.fragments
  Graph mine_;                                                              // of this tick
  int round_ = kGraphs;                                                     // in which the graphs go around
  std::vector<Graph> graphs_;                                               // of this tick, own included
  std::set<RegionId> senders_;                                              // who sends a transfer in this tick
};

}  // namespace

std::unique_ptr<Protocol> MakeSyncExchange(Holdings& holdings, bool joins) {
  return std::make_unique<SyncExchange>(holdings, joins);
}

}  // namespace aureole
