#include "server/transport/replica_capture.h"

#include <algorithm>
#include <limits>
#include <utility>

namespace aureole {
namespace {

constexpr double kInf = std::numeric_limits<double>::infinity();
// A query of the tree costs about as much as this many bodies that are only looked at.
constexpr size_t kQueryCost = 16;

bool ById(const BodyPose& x, const BodyPose& y) { return x.id < y.id; }

void SortUnique(std::vector<BodyPose>* poses) {
  std::sort(poses->begin(), poses->end(), ById);
  poses->erase(std::unique(poses->begin(), poses->end(), [](const auto& x, const auto& y) { return x.id == y.id; }),
               poses->end());
}

void SortUnique(std::vector<BodyId>* ids) {
  std::sort(ids->begin(), ids->end());
  ids->erase(std::unique(ids->begin(), ids->end()), ids->end());
}

// Cells that `now` watches and `before` (may be null) did not.
std::vector<CellKey> NewCells(const Watch& now, const Watch* before) {
  std::vector<CellKey> out;
  for (const CellKey& c : now.cells) {
    if (before == nullptr || !before->Contains(c)) out.push_back(c);
  }
  std::sort(out.begin(), out.end());
  return out;
}

}  // namespace

bool ReplicaCapture::Due(const Watch& watch, Tick n) const {
  return std::any_of(watch.periods.begin(), watch.periods.end(), [n](Tick period) { return n % period == 0; });
}

void ReplicaCapture::Take(Region* region, std::shared_ptr<const Watch> watch, Capture* out) {
  const Engine& engine = region->engine();
  out->first = watch_ == nullptr;
  if (out->first) {
    region->WatchChanges(true);
    last_.clear();
  }
  out->tick = region->tick();
  out->watch = watch;
  std::vector<BodyPose>& poses = out->poses;
  poses.clear();
  out->fresh.clear();
  BodyChanges changes = region->TakeChanges();
  out->gone = std::move(changes.gone);

  // What is new as a whole.
  if (watch->everything && (out->first || !watch_->everything)) {
    engine.AppendPoses({Vec3::Constant(-kInf), Vec3::Constant(kInf)}, &poses);
  } else if (!watch->everything) {
    TakeCells(engine, NewCells(*watch, watch_.get()), &poses);
  }
  std::vector<BodyId> fresh = changes.came;
  for (const BodyPose& p : poses) fresh.push_back(p.id);

  // What moves.
  const bool few = !watch->everything &&
                   2 * last_.size() + kQueryCost * watch->cells.size() < static_cast<size_t>(engine.CountAwake());
  if (few) {
    TakeCells(engine, {watch->cells.begin(), watch->cells.end()}, &poses);
  } else {
    TakeAwake(engine, *watch, &poses);
  }
  for (const std::vector<BodyId>* list : {&changes.came, &changes.slept}) {
    for (BodyId id : *list) {
      if (engine.Contains(id)) poses.push_back(engine.Pose(id));
    }
  }
  std::erase_if(poses, [&](const BodyPose& p) { return !watch->Contains(CellOf(p.position)); });
  SortUnique(&poses);

  std::vector<BodyId> now;
  now.reserve(poses.size());
  for (const BodyPose& p : poses) now.push_back(p.id);
  std::set_difference(now.begin(), now.end(), last_.begin(), last_.end(), std::back_inserter(fresh));
  SortUnique(&fresh);
  for (BodyId id : fresh) {
    if (std::binary_search(now.begin(), now.end(), id)) {
      out->fresh.push_back({id, region->EpochOf(id), engine.Look(id)});
    }
  }
  // What was watched and is so no more, but still here: asleep, or elsewhere. One that slept may have left at once.
  last_.insert(last_.end(), changes.woke.begin(), changes.woke.end());
  SortUnique(&last_);
  std::vector<BodyId> before;
  std::set_difference(last_.begin(), last_.end(), now.begin(), now.end(), std::back_inserter(before));
  for (BodyId id : before) {
    if (engine.Contains(id)) poses.push_back(engine.Pose(id));
  }
  if (!before.empty()) std::sort(poses.begin(), poses.end(), ById);
  last_ = std::move(now);
  watch_ = std::move(watch);
}

void ReplicaCapture::Stop(Region* region) {
  if (watch_ == nullptr) return;
  watch_.reset();
  region->WatchChanges(false);
}

void ReplicaCapture::TakeAwake(const Engine& engine, const Watch& watch, std::vector<BodyPose>* out) const {
  const auto first = static_cast<std::ptrdiff_t>(out->size());
  engine.AppendAwake(out);
  if (watch.everything) return;
  out->erase(std::remove_if(out->begin() + first, out->end(),
                            [&watch](const BodyPose& p) { return !watch.Contains(CellOf(p.position)); }),
             out->end());
}

void ReplicaCapture::TakeCells(const Engine& engine, const std::vector<CellKey>& cells,
                               std::vector<BodyPose>* out) const {
  for (const CellKey& c : cells) {
    const auto first = static_cast<std::ptrdiff_t>(out->size());
    const auto low = [](int32_t cell) { return cell > -kLastCell - 1 ? cell * kCellSize : -kInf; };
    const auto high = [](int32_t cell) { return cell < kLastCell ? (cell + 1) * kCellSize : kInf; };
    engine.AppendPoses({Vec3(low(c.x), -kInf, low(c.z)), Vec3(high(c.x), kInf, high(c.z))}, out);
    out->erase(
        std::remove_if(out->begin() + first, out->end(), [&c](const BodyPose& p) { return CellOf(p.position) != c; }),
        out->end());
  }
}

}  // namespace aureole
