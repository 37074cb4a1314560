#include "server/transport/replica_capture.h"

#include <algorithm>
#include <limits>
#include <tuple>
#include <utility>

namespace aureole {
namespace {

constexpr double kInf = std::numeric_limits<double>::infinity();
// A query of the tree costs about as much as this many bodies that are only looked at.
constexpr size_t kQueryCost = 16;

bool ById(const BodyPose& x, const BodyPose& y) { return x.id < y.id; }

void SortUnique(std::vector<BodyPose>* poses) {
  const auto ascend = [](const BodyPose& x, const BodyPose& y) { return x.id >= y.id; };
  if (std::adjacent_find(poses->begin(), poses->end(), ascend) == poses->end()) return;
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

std::vector<CellRect> RectsOf(std::vector<CellKey> cells) {
  // Runs along x, then runs of equal ones along z.
  std::sort(cells.begin(), cells.end(),
            [](const CellKey& a, const CellKey& b) { return a.z != b.z ? a.z < b.z : a.x < b.x; });
  std::vector<CellRect> runs;
  for (const CellKey& c : cells) {
    if (!runs.empty() && runs.back().high.z == c.z && runs.back().high.x == c.x - 1) {
      runs.back().high.x = c.x;
    } else {
      runs.push_back({c, c});
    }
  }
  std::sort(runs.begin(), runs.end(), [](const CellRect& a, const CellRect& b) {
    return std::tie(a.low.x, a.high.x, a.low.z) < std::tie(b.low.x, b.high.x, b.low.z);
  });
  std::vector<CellRect> out;
  for (const CellRect& r : runs) {
    const bool grows = !out.empty() && out.back().low.x == r.low.x && out.back().high.x == r.high.x &&
                       out.back().high.z == r.low.z - 1;
    if (grows) {
      out.back().high.z = r.high.z;
    } else {
      out.push_back(r);
    }
  }
  return out;
}

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
    TakeRects(engine, RectsOf(NewCells(*watch, watch_.get())), &poses);
  }
  std::vector<BodyId> fresh = changes.came;
  for (const BodyPose& p : poses) fresh.push_back(p.id);

  // What moves.
  const bool few = !watch->everything &&
                   2 * last_.size() + kQueryCost * watch->rects.size() < static_cast<size_t>(engine.CountAwake());
  if (few) {
    TakeRects(engine, watch->rects, &poses);
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

void ReplicaCapture::TakeRects(const Engine& engine, const std::vector<CellRect>& rects,
                               std::vector<BodyPose>* out) const {
  const auto low = [](int32_t cell) { return cell > -kLastCell - 1 ? cell * kCellSize : -kInf; };
  const auto high = [](int32_t cell) { return cell < kLastCell ? (cell + 1) * kCellSize : kInf; };
  for (const CellRect& r : rects) {
    const auto first = static_cast<std::ptrdiff_t>(out->size());
    engine.AppendPoses({Vec3(low(r.low.x), -kInf, low(r.low.z)), Vec3(high(r.high.x), kInf, high(r.high.z))}, out);
    // Boxes that reach in from outside.
    out->erase(std::remove_if(out->begin() + first, out->end(),
                              [&r](const BodyPose& p) { return !r.Contains(CellOf(p.position)); }),
               out->end());
  }
}

}  // namespace aureole
