#include "server/transport/replica_scene.h"

#include <algorithm>
#include <utility>

#include "aureole/v1/simulation.pb.h"
#include "server/transport/shape_proto.h"

namespace aureole {
namespace {

std::string Describe(const BodyLook& look) {
  v1::BodyDescription out;
  *out.mutable_shape() = ShapeToProto(*look.shape);
  *out.mutable_material() = MaterialToProto(look.material);
  out.set_mass(look.mass);
  return out.SerializeAsString();
}

bool Same(const CellState& x, const CellState& y) {
  return std::equal(
      x.bodies.begin(), x.bodies.end(), y.bodies.begin(), y.bodies.end(),
      [](const CellBody& a, const CellBody& b) { return a.id == b.id && a.epoch == b.epoch && a.pose == b.pose; });
}

}  // namespace

void ReplicaScene::Apply(const Capture& capture) {
  if (capture.first) {
    bodies_.clear();
    cells_.clear();
    fates_.clear();
    handed_over_.clear();
  }
  tick_ = capture.tick;
  if (watch_ != capture.watch && watch_ != nullptr && !capture.watch->everything) {
    std::vector<BodyId> unwatched;
    for (const auto& [id, body] : bodies_) {
      if (!capture.watch->Contains(body.cell)) unwatched.push_back(id);
    }
    for (BodyId id : unwatched) Remove(id);
  }
  watch_ = capture.watch;

  for (const BodyChanges::Gone& g : capture.gone) {
    fates_[g.id] = g;
    if (g.to != kNoRegion) handed_over_.push_back({tick_, g});
    Remove(g.id);
  }
  for (const Capture::Fresh& f : capture.fresh) {
    Body& body = bodies_[f.id];
    fates_.erase(f.id);
    body.epoch = f.epoch;
    body.look = Describe(f.look);
  }
  constexpr size_t kAhead = 8;  // in a large world they are far from the processor
  for (size_t i = 0; i < capture.poses.size(); ++i) {
    if (i + kAhead < capture.poses.size()) bodies_.prefetch(capture.poses[i + kAhead].id);
    const BodyPose& pose = capture.poses[i];
    const auto it = bodies_.find(pose.id);
    if (it == bodies_.end()) continue;  // it left what is watched before this
    const CellKey cell = CellOf(pose.position);
    if (!watch_->Contains(cell)) {
      Remove(pose.id);
      continue;
    }
    it->second.pose = pose;
    it->second.valid = {};
    Put(pose.id, &it->second, cell);
  }
}

std::shared_ptr<const CellState> ReplicaScene::State(const CellKey& key, Precision precision) {
  const auto it = cells_.find(key);
  if (it == cells_.end()) return nullptr;
  Cell& cell = it->second;
  const auto p = static_cast<size_t>(precision);
  if (cell.state_versions[p] == cell.version) return cell.states[p];
  auto state = std::make_shared<CellState>();
  state->key = key;
  state->bodies.reserve(cell.ids.size());
  for (BodyId id : cell.ids) {
    Body& body = bodies_.at(id);
    state->bodies.push_back({id, body.epoch, Quantised(&body, precision)});
    if (precision == Precision::kExact) state->exact.push_back(body.pose);
  }
  cell.state_versions[p] = cell.version;
  const bool same = precision != Precision::kExact && cell.states[p] != nullptr && Same(*state, *cell.states[p]);
  if (!same) cell.states[p] = std::move(state);
  return cell.states[p];
}

const std::string* ReplicaScene::Look(BodyId id) const {
  const auto it = bodies_.find(id);
  return it == bodies_.end() ? nullptr : &it->second.look;
}

Tick ReplicaScene::LastArrival(const CellKey& cell) const {
  const auto it = cells_.find(cell);
  return it == cells_.end() ? 0 : it->second.arrival;
}

const CellKey* ReplicaScene::CellOfBody(BodyId id) const {
  const auto it = bodies_.find(id);
  return it == bodies_.end() ? nullptr : &it->second.cell;
}

void ReplicaScene::Forget(Tick n) {
  absl::erase_if(fates_, [n](const auto& e) { return e.second.from < n; });
  while (!handed_over_.empty() && handed_over_.front().tick < n) handed_over_.pop_front();
}

void ReplicaScene::Remove(BodyId id) {
  const auto it = bodies_.find(id);
  if (it == bodies_.end()) return;
  if (it->second.placed) TakeOut(id, it->second.cell);
  bodies_.erase(it);
}

void ReplicaScene::Put(BodyId id, Body* body, const CellKey& cell) {
  const bool placed = std::exchange(body->placed, true);
  if (!placed || body->cell != cell) {
    if (placed) TakeOut(id, body->cell);
    body->cell = cell;
    Cell& to = cells_[cell];
    to.ids.insert(std::lower_bound(to.ids.begin(), to.ids.end(), id), id);
    if (!placed) to.arrival = tick_;
  }
  ++cells_[cell].version;
}

void ReplicaScene::TakeOut(BodyId id, const CellKey& key) {
  const auto it = cells_.find(key);
  std::vector<BodyId>& ids = it->second.ids;
  ids.erase(std::lower_bound(ids.begin(), ids.end(), id));
  ++it->second.version;
  if (ids.empty()) cells_.erase(it);
}

const QuantisedPose& ReplicaScene::Quantised(Body* body, Precision precision) {
  const size_t p = precision == Precision::kCoarse ? 1 : 0;
  QuantisedPose& q = body->quantised[p];
  if (!std::exchange(body->valid[p], true)) q = Quantise(body->pose, p == 1 ? kCoarseQuanta : kFineQuanta, q.largest);
  return q;
}

}  // namespace aureole
