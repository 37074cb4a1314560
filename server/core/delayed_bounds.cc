// How far bodies may get within the horizon: by the speed tolerance, or by their energy (R12).
#include <algorithm>
#include <map>

#include "server/core/check.h"
#include "server/core/delayed_exchange.h"
#include "server/core/reach.h"

namespace aureole {

void DelayedExchange::AnnounceKicks() {
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

void DelayedExchange::SetBounds() {
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

double DelayedExchange::KickEnergy(BodyId id, const BodyView& v) const {
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

void DelayedExchange::ComputeReach() {
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

Aura DelayedExchange::AuraOf(BodyId id) const {
  if (auto s = shadows_.find(id); s != shadows_.end()) {
    const auto& states = s->second.states;
    return MakeAura(id, states[std::min<size_t>(h_.tick - s->second.sent, states.size() - 1)].view, s->second.owner);
  }
  for (const auto& [peer, auras] : remote_) {
    if (auto a = auras.find(id); a != auras.end()) return a->second;
  }
  AUREOLE_CHECK(false, "no aura of body %llu", static_cast<unsigned long long>(id));
}

DelayedExchange::Bound DelayedExchange::BoundOf(BodyId id, bool* grown) {
  if (!reach_) return same_;
  auto [it, fresh] = bounds_.try_emplace(id);
  *grown |= fresh;
  return it->second;
}

}  // namespace aureole
