// The fixed-delay exchange, k >= 1: Aura Projection proper (PROTOCOL.md sections 2 to 8). A frame sent after tick n is
// applied before tick n + k, never earlier, never later; what may meet within that horizon is co-hosted ahead of time.
//
// A cluster that is sent is stepped k-1 ticks on its own *by the sender, at once*, and travels as the state in which
// its receiver takes it over. That is the same computation as R2's shadow and the receiver's fast-forward, done once.
//
// One class in four files: delayed_exchange.cc the tick and the transfers, delayed_bounds.cc how far bodies may get,
// delayed_decision.cc who must be together, delayed_projection.cc what peers are told.
#pragma once

#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <absl/container/flat_hash_map.h>

#include "server/core/holdings.h"
#include "server/core/reach.h"
#include "server/core/union_find.h"

namespace aureole {

// A body turns faster than its box may grow, so the protocol uses the box of its bounding sphere (PROTOCOL.md, "Gap").
inline Box SphereBox(const BodyView& v) { return {v.centre.array() - v.radius, v.centre.array() + v.radius}; }

class DelayedExchange final : public Protocol {
 public:
  explicit DelayedExchange(Holdings& holdings);

  Phase phase() const override { return phase_; }

  bool Ready() const override;

  void Missing(std::vector<RegionId>* out) const override;

  bool MaySend(RegionId, int round, const Division::State&) const override { return round == 0; }

  void Advance(std::vector<Frame>* out) override;

  void ObserveInFlight(std::vector<BodyRecord>* out) const override;
  void AppendAuras(size_t most, std::vector<WireBox>* out) const override;
  void Save(Writer& a) const override { const_cast<DelayedExchange*>(this)->Visit(a); }
  void Load(Reader& a) override { Visit(a); }

 private:
  // R12: what a body can do within the horizon, and what its aura says of it.
  struct Bound {
    double push = 0, give = 0;  // m, as in Node
    BodyId group = 0;
    std::vector<double> energies;  // of the group, J: of own bodies, then as each peer tells

    template <class Archive>
    void Visit(Archive& a) {
      a(push, give, group, energies);
    }
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

      template <class Archive>
      void Visit(Archive& a) {
        a(exists, steps, view, box, hash);
      }
    };
    std::vector<State> states;
    Bound bound;  // when it was sent

    template <class Archive>
    void Visit(Archive& a) {
      a(owner, epoch, sent, group, states, bound);
    }
  };

  // A node of the graph that the decision of this tick looks at (R3).
  struct Node {
    BodyId id;
    RegionId owner;
    Box box;
    bool own;
    double push = 0, give = 0;  // an edge when the gap is at most the sum of both: for AC, and for BT
    int source = 0;             // 1 + index of the peer that tells of it; 0: this region knows it itself
  };

  // What outlives a tick.
  template <class Archive>
  void Visit(Archive& a) {
    a(started_, groups_, remote_, away_, shadows_, waiting_, bounds_, most_push_, most_give_, kicks_, area_kicks_,
      announced_, told_, told_away_, said_);
  }

  Tick now() const { return h_.tick + 1; }

  // The frames that Begin of tick now() needs; -1: none.
  Tick DueFrame() const;

  void Begin();
  // What all regions said in the frames of tick n.
  void HearInputs(Tick n);

  void Apply(Frame f, RegionId peer);
  void FindLiveSpawns(Transfer* t) const;

  // A broken horizon: an arrival overlapped an owned body already one step ago, when the two were stepped apart.
  void CheckArrival(const Transfer& t);

  BodyView ViewOf(const BodySpec& spec) const;

  // R11: a spawn is shown, owned and transferable from `spawn_notice` ticks before it takes effect.
  void AnnounceSpawns();

  void DropOldShadows();

  void CountHomes();

  double ProjectReach() const { return margins_.project * step_; }

  // R11, `reach`: impulses of the script are known as far ahead as an aura's bound must reach.
  void AnnounceKicks();

  const BodyView OwnView(BodyId id) const;

  // Own bodies, waiting spawns included, whose sphere box comes within `gap` of the box.
  void OwnNear(const Box& box, double gap, std::vector<BodyId>* out) const;

  // Everything of others that this region knows: their auras in state n-k, and its own departures, known at once (R1),
  // in the newest state that their shadow has.
  void FindForeign();

  void Detect();

  // How far everything reaches. `tolerance`: as far as the speed tolerance allows, everything alike.
  void SetBounds();

  ReachNode OwnReach(BodyId id, Energies* energies) const;
  double KickEnergy(BodyId id, const BodyView& v) const;

  // R12. Foreign states are k ticks old: they move alone until now, then everything together; H - k ticks on is what AC
  // looks at, H + k what BT looks at and what an aura says.
  void ComputeReach();
  void ForeignReach(std::vector<ReachNode>* nodes, Energies* energies) const;

  // Where the peer's part of a bound's energies is.
  int SourceOf(RegionId peer) const { return 1 + (peer > h_.self ? peer - 1 : peer); }

  // The bound of an own body. `grown` is set when it had none: then all must be computed again, with it.
  Bound BoundOf(BodyId id, bool* grown);

  // The paper's AC (Algorithm 1) by R3 and R4: components over everything that may meet, reached from what is foreign;
  // all own members go straight to the best rank among the owners.
  void AuraCollision();

  // False when bodies came up whose reach is not known yet.
  bool FindComponents(std::vector<Node>* found, UnionFind* sets);

  void Push(const std::vector<Node>& nodes, const std::vector<int>& members);

  // The paper's BT (Algorithm 2) by R6: an island goes home.
  void BoundaryTraverse();

  // Grows `island` over D_ret until it is complete or something forbids its return. Components that were found to stay
  // are not walked again.
  bool IslandQuery(std::vector<BodyId>* island, absl::flat_hash_map<BodyId, bool>* verdict);

  void Send(std::vector<BodyId> ids, RegionId to, TransferCause cause);

  // `last`: the view of a body that is not there (not yet, or no more).
  static Shadow::State StateOf(const Engine& engine, BodyId id, const BodyView& last);

  // Steps the cluster through the k-1 ticks of its flight, on its own, with the inputs of these ticks.
  void FastForward(Transfer* t);

  // A body that was removed in flight does not arrive.
  void ForgetRemoved(Transfer* t) const;

  using Auras = std::map<BodyId, Aura>;

  // What `peer` gets to know of the body.
  Aura MakeAura(BodyId id, const BodyView& v, RegionId owner, RegionId peer) const;

  // The paper's BNU (Algorithm 6). R9: whom to tell is computed afresh as a set each tick; OBC, OBU and OBE (Algorithms
  // 3 to 5) are its differences from the set before.
  void BoundaryNetworkUpdate(std::vector<Frame>* out);

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

  void Project(std::map<RegionId, Auras>* next, std::map<BodyId, Away>* away);

  void ProjectToRegions(BodyId id, const BodyView& v, RegionId owner, std::map<RegionId, Auras>* next,
                        std::map<BodyId, Away>* away);

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
  std::multimap<BodyId, Input> kicks_;           // impulses that are announced
  std::vector<Input> area_kicks_;                // the same, over areas
  Tick announced_ = 0;                           // up to this tick
  std::vector<BodyId> near_;
  std::map<RegionId, std::vector<Transfer>> leaving_;
  std::map<RegionId, Auras> told_;
  std::map<BodyId, Away> told_away_;
  std::map<Tick, std::vector<Graph>> said_;  // inputs, by all, in frames that are not yet applied everywhere
};

}  // namespace aureole
