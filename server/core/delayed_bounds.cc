// How far bodies may get within the horizon: by the speed tolerance, or by their energy (R12).
#include <algorithm>
#include <cmath>
#include <map>
#include <tuple>

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
    h_.AppendInputs(announced_ + 1, &inputs);
    for (const Input& i : inputs) {
      if (i.kind == Input::Kind::kSpawn || i.kind == Input::Kind::kRemove) continue;
      if (i.over_area()) {
        area_kicks_.push_back(i);
      } else {
        kicks_.emplace(i.body, i);
      }
    }
  }
  std::erase_if(kicks_, [this](const auto& e) { return e.second.tick <= h_.tick; });
  std::erase_if(area_kicks_, [this](const Input& i) { return i.tick <= h_.tick; });
}

void DelayedExchange::SetBounds() {
  same_ = {margins_.predict * step_ / 2, margins_.give_back * step_ / 2, 0, {}};
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

// The root of twice the kinetic energy is a norm of the velocities, so that what inputs add to it adds up at most.
double DelayedExchange::KickEnergy(BodyId id, const BodyView& v) const {
  // No body of mass m inside a sphere of radius r has an inertia of more than m r^2.
  const double most_inertia = v.mass * v.radius * v.radius;
  double norm = std::sqrt(2 * v.energy);
  auto add = [&](const Input& i) {
    const double linear = i.linear.norm() + std::abs(i.area.outward);
    double angular = i.angular.norm();
    if (i.kind == Input::Kind::kImpulse) {
      if (i.frame != Input::Frame::kCentre) angular += linear * v.radius;
      norm += linear / std::sqrt(v.mass) + angular / std::sqrt(v.least_inertia);
    } else {
      const double kick = std::sqrt(v.mass * linear * linear + most_inertia * angular * angular);
      norm = i.kind == Input::Kind::kVelocity ? std::max(norm, kick) : norm + kick;
    }
  };
  const auto [begin, end] = kicks_.equal_range(id);
  for (auto it = begin; it != end; ++it) add(it->second);
  for (const Input& i : area_kicks_) {
    const double way = static_cast<double>(i.tick - h_.tick) * step_;
    if ((v.centre - i.area.centre).norm() <= i.area.radius + way) add(i);
  }
  return norm * norm / 2;
}

// What is foreign, with the energies of its groups, in the states that are known of it.
void DelayedExchange::ForeignReach(std::vector<ReachNode>* nodes, Energies* energies) const {
  std::map<std::tuple<int, RegionId, BodyId>, int> groups;
  for (const Node& f : foreign_) {
    ReachNode n;
    n.id = f.id;
    n.box = f.box;
    n.source = f.source;
    const auto enter = [&](BodyId name) {
      auto [it, fresh] = groups.emplace(std::tuple{f.source, f.owner, name}, 0);
      if (fresh) it->second = energies->Add();
      n.group = it->second;
    };
    const auto raise = [&](int source, double joules) {
      energies->At(n.group, source) = std::max(energies->At(n.group, source), joules);
    };
    if (f.source == 0) {
      const Shadow& s = shadows_.at(f.id);
      n.mass = s.states.front().view.mass;
      enter(s.bound.group);
      for (size_t i = 0; i < s.bound.energies.size(); ++i) raise(static_cast<int>(i), s.bound.energies[i]);
      raise(0, s.states.front().view.energy);
    } else {
      const Aura& a = remote_.at(h_.peers[static_cast<size_t>(f.source - 1)]).at(f.id);
      n.mass = std::max(1e-9, static_cast<double>(a.mass));
      enter(a.group);
      raise(f.source, a.energy);
    }
    nodes->push_back(n);
  }
}

ReachNode DelayedExchange::OwnReach(BodyId id, Energies* energies) const {
  const BodyView v = OwnView(id);
  const int group = energies->Add();
  energies->At(group, 0) = KickEnergy(id, v);
  // What pushes bodies apart ends when they are apart: it adds to a speed once, not in every tick.
  const double push = h_.world.exchange.recovery / h_.world.environment.dt();
  return {id, SphereBox(v), v.mass, group, 0, 0, push};
}

void DelayedExchange::ComputeReach() {
  const Environment& e = h_.world.environment;
  const ReachLimits limits{h_.world.tolerances.speed, h_.world.exchange.recovery, e.gravity.norm(), e.dt()};
  std::vector<ReachNode> nodes;
  Energies energies(1 + static_cast<int>(h_.peers.size()));
  ForeignReach(&nodes, &energies);
  PropagateReach(nodes, &energies, {}, k_, limits);
  const size_t foreign = nodes.size();
  absl::flat_hash_map<BodyId, int> index;
  std::vector<BodyId> ids;
  for (const auto& [id, bound] : bounds_) ids.push_back(id);
  std::sort(ids.begin(), ids.end());
  for (BodyId id : ids) {
    index[id] = static_cast<int>(nodes.size());
    nodes.push_back(OwnReach(id, &energies));
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
  std::vector<BodyId> name(static_cast<size_t>(energies.groups()), 0);
  for (size_t i = 0; i < nodes.size(); ++i) {
    const ReachNode& n = nodes[i];
    if (i < foreign) {
      foreign_[i].give = n.distance;
      continue;
    }
    Bound& bound = bounds_[n.id];
    bound.give = n.distance;
    most_give_ = std::max(most_give_, n.distance);
    BodyId& group = name[static_cast<size_t>(n.group)];
    if (group == 0) group = n.id;
    bound.group = group;
    const std::span<const double> parts = energies.Of(n.group);
    bound.energies.assign(parts.begin(), parts.end());
  }
}

DelayedExchange::Bound DelayedExchange::BoundOf(BodyId id, bool* grown) {
  if (!reach_) return same_;
  auto [it, fresh] = bounds_.try_emplace(id);
  *grown |= fresh;
  return it->second;
}

}  // namespace aureole
