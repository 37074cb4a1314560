// What peers are told: BNU, OBC, OBU and OBE, the paper's Algorithms 3 to 6, by rule R9.
#include <algorithm>
#include <cmath>
#include <limits>

#include "server/core/delayed_exchange.h"

namespace aureole {

void DelayedExchange::CountHomes() {
  near_.clear();
  h_.engine->CollectOutside(h_.rect, ProjectReach() + h_.engine->MaxRadius(), &near_);
  h_.CountHomes(near_);
  h_.stats.aura_tests += static_cast<int64_t>(near_.size());
}

Aura DelayedExchange::MakeAura(BodyId id, const BodyView& v, RegionId owner, RegionId peer) const {
  Aura a;
  a.id = id;
  a.box = RoundOutward(SphereBox(v));
  a.owner = owner;
  if (!reach_) return a;
  const Bound* bound = nullptr;
  if (auto s = shadows_.find(id); s != shadows_.end()) {
    bound = &s->second.bound;
  } else if (auto b = bounds_.find(id); b != bounds_.end()) {
    bound = &b->second;
  }
  a.group = bound != nullptr && bound->group != 0 ? bound->group : id;
  double energy = 0;
  if (bound != nullptr) {
    for (size_t i = 0; i < bound->energies.size(); ++i) {
      if (static_cast<int>(i) != SourceOf(peer)) energy += bound->energies[i];
    }
  }
  energy = std::max(energy, v.energy);
  a.energy = std::nextafter(static_cast<float>(energy), std::numeric_limits<float>::infinity());
  if (energy == 0) a.energy = 0;
  a.mass = std::nextafter(static_cast<float>(v.mass), 0.0f);
  return a;
}

void DelayedExchange::BoundaryNetworkUpdate(std::vector<Frame>* out) {
  std::map<RegionId, Auras> next;
  std::map<BodyId, Away> away;
  Project(&next, &away);
  h_.stats.auras_told = 0;
  Graph said;
  said.of = h_.self;
  said.inputs = h_.live.TakeOffered();
  said.applied = h_.live.TakeApplied();
  said_[h_.tick].push_back(said);
  for (RegionId peer : h_.peers) {
    Frame f;
    f.from = h_.self;
    f.to = {peer};
    f.tick = h_.tick;
    Difference(told_[peer], next[peer], &f.auras, &f.gone);
    Difference(told_away_, away, &f.away, &f.away_gone);
    if (!said.empty()) f.graphs = {said};
    if (auto it = leaving_.find(peer); it != leaving_.end()) f.transfers = std::move(it->second);
    h_.stats.auras_sent += static_cast<int64_t>(f.auras.size());
    h_.stats.auras_told += static_cast<int64_t>(next[peer].size());
    told_[peer] = std::move(next[peer]);
    out->push_back(std::move(f));
  }
  leaving_.clear();
  told_away_ = std::move(away);
}

void DelayedExchange::Project(std::map<RegionId, Auras>* next, std::map<BodyId, Away>* away) {
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
      for (BodyId id : hits) told.try_emplace(id, MakeAura(id, OwnView(id), h_.self, a.owner));
      for (const auto& [id, s] : shadows_) {
        if (h_.tick - s.sent >= k_) continue;
        const BodyView& v = s.states[h_.tick - s.sent].view;
        if (Gap(SphereBox(v), box) <= reach) told.try_emplace(id, MakeAura(id, v, s.owner, a.owner));
      }
    }
  }
}

void DelayedExchange::ProjectToRegions(BodyId id, const BodyView& v, RegionId owner, std::map<RegionId, Auras>* next,
                                       std::map<BodyId, Away>* away) {
  const Box box = SphereBox(v);
  const double reach = ProjectReach();
  for (RegionId peer : h_.peers) {
    if (h_.layout().rect(peer).Gap(box) <= reach) (*next)[peer].emplace(id, MakeAura(id, v, owner, peer));
  }
  if (!h_.layout().rect(owner).Encloses(box, 0)) (*away)[id] = {id, owner, RoundOutward(box)};
}

}  // namespace aureole
