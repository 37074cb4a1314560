#include "client/src/replica_merger.h"

#include <algorithm>
#include <limits>

namespace aureole::client {

void ReplicaMerger::Follow(uint64_t layout_epoch, const std::vector<int32_t>& regions) {
  layout_epoch_ = layout_epoch;
  settles_at_.reset();
  const auto is_there = [&](int32_t region) {
    return std::find(regions.begin(), regions.end(), region) != regions.end();
  };
  std::erase_if(regions_, [&](const auto& e) { return !is_there(e.first); });
  for (int32_t region : regions) regions_.try_emplace(region);
  for (const auto& [id, body] : bodies_) {
    const auto transit = transits_.find(id);
    if (!is_there(transit != transits_.end() ? transit->second.region : body.region)) Orphan(id);
  }
}

void ReplicaMerger::Apply(int32_t region, const ReplicaDecoder& decoder, const v1::ReplicaFrame& frame) {
  lost_.clear();
  Told& told = regions_[region];
  if (frame.base_tick() == 0) {
    told.whole_since.reset();
    told.whole.reset();
    settles_at_.reset();
  }
  for (uint64_t id : decoder.changed()) Take(region, decoder, id);
  for (const LostBody& l : decoder.lost()) HandOver(region, frame, l);
  told.tick = decoder.tick();
  told.layout_epoch = frame.layout_epoch();
  if (!frame.more()) {
    told.whole = told.tick;
    if (!told.whole_since.has_value()) {
      told.whole_since = told.tick;
      Reconcile(region, decoder);
    }
    Settle(region, decoder);
    LoseOrphans();
  }
  ForgetRemoved();
}

void ReplicaMerger::Take(int32_t region, const ReplicaDecoder& decoder, uint64_t id) {
  if (!decoder.Contains(id) || removed_.contains(id)) return;
  const ToldBody state = decoder.Get(id);
  const auto [it, fresh] = bodies_.try_emplace(id);
  MergedBody& body = it->second;
  if (!fresh && state.epoch < body.state.epoch) return;  // a late word of a former server
  const int64_t held = body.region == region ? regions_[region].tick : 0;
  if (!fresh) {
    std::shift_right(body.before.begin(), body.before.end(), 1);
    body.before[0] = {std::max(body.tick, held), body.state};
  }
  body.region = region;
  body.tick = decoder.tick();
  body.state = state;
  orphans_.erase(id);
  const auto transit = transits_.find(id);
  if (transit != transits_.end() && state.epoch >= transit->second.epoch) transits_.erase(transit);
}

void ReplicaMerger::HandOver(int32_t region, const v1::ReplicaFrame& frame, const LostBody& l) {
  const auto it = bodies_.find(l.body);
  if (l.why == LostBody::Why::kRemoved) removed_[l.body] = frame.tick();
  if (it == bodies_.end()) return;
  if (l.why == LostBody::Why::kMoved) {
    const auto known = transits_.find(l.body);
    if (l.epoch <= it->second.state.epoch || (known != transits_.end() && l.epoch <= known->second.epoch)) return;
    orphans_.erase(l.body);
    transits_[l.body] = {l.region, l.epoch, l.tick};
    // A region that is not known will come with the next layout, or has left since.
    if (!regions_.contains(l.region) && frame.layout_epoch() <= layout_epoch_) Orphan(l.body);
  } else if (it->second.region == region && !transits_.contains(l.body)) {
    Lose(l);
  }
}

// Bodies that should be here by now. A stream that told everything before they came would have said where they went.
void ReplicaMerger::Settle(int32_t region, const ReplicaDecoder& decoder) {
  std::vector<uint64_t> gone, unknown;
  const int64_t since = *regions_[region].whole_since;
  for (const auto& [id, t] : transits_) {
    if (t.region != region || decoder.tick() < t.tick || decoder.Contains(id)) continue;
    (since <= t.tick ? gone : unknown).push_back(id);
  }
  for (uint64_t id : gone) Lose({id});
  for (uint64_t id : unknown) Orphan(id);
}

// After a new stream has told all that is in view.
void ReplicaMerger::Reconcile(int32_t region, const ReplicaDecoder& decoder) {
  for (const auto& [id, body] : bodies_) {
    if (body.region == region && !transits_.contains(id) && !decoder.Contains(id)) Orphan(id);
  }
}

// Somebody has each body at each tick. When all have told everything, whoever has an orphan at the newest of their
// ticks has told it, or will have when it has come to that tick; or will say to whom it has gone.
void ReplicaMerger::LoseOrphans() {
  if (orphans_.empty()) return;
  int64_t newest = 0;
  for (const auto& [region, told] : regions_) {
    if (!told.whole.has_value() || told.layout_epoch < layout_epoch_) return;
    newest = std::max(newest, told.tick);
  }
  if (!settles_at_.has_value()) settles_at_ = newest;
  for (const auto& [region, told] : regions_) {
    if (*told.whole < *settles_at_) return;
  }
  const std::vector<uint64_t> gone(orphans_.begin(), orphans_.end());
  for (uint64_t id : gone) Lose({id});
}

void ReplicaMerger::Orphan(uint64_t body) {
  transits_.erase(body);
  orphans_.insert(body);
  settles_at_.reset();
}

void ReplicaMerger::Lose(const LostBody& lost) {
  bodies_.erase(lost.body);
  transits_.erase(lost.body);
  orphans_.erase(lost.body);
  lost_.push_back(lost);
}

void ReplicaMerger::ForgetRemoved() {
  if (removed_.empty()) return;
  int64_t oldest = std::numeric_limits<int64_t>::max();
  for (const auto& [region, told] : regions_) oldest = std::min(oldest, told.tick);
  std::erase_if(removed_, [oldest](const auto& e) { return e.second < oldest; });
}

}  // namespace aureole::client
