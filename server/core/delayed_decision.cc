// Who must be together: AC and BT, the paper's Algorithms 1 and 2, by rules R3 to R8.
#include <algorithm>
#include <set>

#include "server/core/delayed_exchange.h"

namespace aureole {

void DelayedExchange::OwnNear(const Box& box, double gap, std::vector<BodyId>* out) const {
  std::vector<BodyId> hits;
  h_.engine->Query(box.Inflated(gap + h_.engine->MaxRadius()), &hits);
  for (BodyId id : hits) {
    if (Gap(SphereBox(h_.engine->View(id)), box) <= gap) out->push_back(id);
  }
  for (const auto& [id, view] : waiting_) {
    if (Gap(SphereBox(view), box) <= gap) out->push_back(id);
  }
}

void DelayedExchange::FindForeign() {
  foreign_.clear();
  for (const auto& [id, s] : shadows_) {
    const auto& state = s.states[std::min<size_t>(h_.tick - s.sent, s.states.size() - 1)];
    foreign_.push_back({id, s.owner, SphereBox(state.view), false});
  }
  for (RegionId peer : h_.peers) {
    for (const auto& [id, a] : remote_[peer]) {
      if (h_.held.contains(id) || shadows_.contains(id)) continue;
      foreign_.push_back({id, a.owner, Widen(a.box), false, 0, 0, SourceOf(peer)});
    }
  }
  std::sort(foreign_.begin(), foreign_.end(), [](const Node& x, const Node& y) {
    return x.box.min.x() != y.box.min.x() ? x.box.min.x() < y.box.min.x() : x.id < y.id;
  });
  h_.stats.aura_tests += static_cast<int64_t>(foreign_.size());
}

void DelayedExchange::Detect() {
  leaving_.clear();
  FindForeign();
  moved_.clear();
  SetBounds();
  AuraCollision();
  BoundaryTraverse();
}

void DelayedExchange::AuraCollision() {
  std::vector<Node> nodes;
  UnionFind sets;
  while (!FindComponents(&nodes, &sets)) ComputeReach();
  std::map<int, std::vector<int>> components;
  for (int i = 0; i < sets.size(); ++i) components[sets.Find(i)].push_back(i);
  for (const auto& [representative, members] : components) Push(nodes, members);
}

bool DelayedExchange::FindComponents(std::vector<Node>* found, UnionFind* sets) {
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

void DelayedExchange::Push(const std::vector<Node>& nodes, const std::vector<int>& members) {
  RegionId best = nodes[members.front()].owner;
  std::set<RegionId> owners;
  std::vector<BodyId> ids;
  for (int i : members) {
    owners.insert(nodes[i].owner);
    if (h_.layout().rank(nodes[i].owner) < h_.layout().rank(best)) best = nodes[i].owner;
    if (nodes[i].own) ids.push_back(nodes[i].id);
  }
  if (ids.empty()) return;
  h_.stats.longest_chain = std::max(h_.stats.longest_chain, static_cast<int64_t>(owners.size()));
  h_.stats.largest_component = std::max(h_.stats.largest_component, static_cast<int64_t>(members.size()));
  if (best != h_.self) Send(std::move(ids), best, TransferCause::kAuraCollision);
}

void DelayedExchange::BoundaryTraverse() {
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
      AddMass(&mass, h_.layout().Home(v.centre), v.mass);
    }
    const RegionId home = Heaviest(h_.layout(), mass);
    if (home != h_.self) Send(std::move(island), home, TransferCause::kBoundaryTraverse);
  }
}

bool DelayedExchange::IslandQuery(std::vector<BodyId>* island, absl::flat_hash_map<BodyId, bool>* verdict) {
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

}  // namespace aureole
