#include "client/src/replica_merger.h"

#include <algorithm>

namespace aureole::client {

void ReplicaMerger::Apply(int32_t region, const ReplicaDecoder& decoder, bool more) {
  lost_.clear();
  for (uint64_t id : decoder.changed()) {
    if (!decoder.Contains(id) || removed_.contains(id)) continue;
    const ToldBody told = decoder.Get(id);
    const auto [it, fresh] = bodies_.try_emplace(id);
    MergedBody& body = it->second;
    if (!fresh && told.epoch < body.state.epoch) continue;  // a late word of a former server
    const int64_t held = body.region == region ? ticks_[region] : 0;
    if (!fresh) {
      std::shift_right(body.before.begin(), body.before.end(), 1);
      body.before[0] = {std::max(body.tick, held), body.state};
    }
    body.region = region;
    body.tick = decoder.tick();
    body.state = told;
    const auto transit = transits_.find(id);
    if (transit != transits_.end() && told.epoch >= transit->second.epoch) transits_.erase(transit);
  }
  for (const LostBody& l : decoder.lost()) {
    const auto it = bodies_.find(l.body);
    if (l.why == LostBody::Why::kRemoved) removed_[l.body] = decoder.tick();
    if (it == bodies_.end()) continue;
    if (l.why == LostBody::Why::kMoved) {
      Transit& t = transits_[l.body];
      if (l.epoch > it->second.state.epoch && l.epoch > t.epoch) t = {l.region, l.epoch, l.tick};
      if (t.epoch == 0) transits_.erase(l.body);
    } else if (it->second.region == region && !transits_.contains(l.body)) {
      Lose(l);
    }
  }
  ticks_[region] = decoder.tick();
  if (!more) Settle(region, decoder);
  ForgetRemoved();
}

void ReplicaMerger::ForgetRemoved() {
  if (removed_.empty()) return;
  int64_t oldest = ticks_.begin()->second;
  for (const auto& [region, tick] : ticks_) oldest = std::min(oldest, tick);
  std::erase_if(removed_, [oldest](const auto& e) { return e.second < oldest; });
}

// Bodies that should be here by now.
void ReplicaMerger::Settle(int32_t region, const ReplicaDecoder& decoder) {
  std::vector<LostBody> gone;
  for (const auto& [id, t] : transits_) {
    if (t.region == region && decoder.tick() >= t.tick && !decoder.Contains(id)) gone.push_back({id});
  }
  for (const LostBody& l : gone) Lose(l);
}

void ReplicaMerger::Reconcile(int32_t region, const ReplicaDecoder& decoder) {
  lost_.clear();
  std::vector<LostBody> gone;
  for (const auto& [id, body] : bodies_) {
    if (body.region == region && !transits_.contains(id) && !decoder.Contains(id)) gone.push_back({id});
  }
  for (const LostBody& l : gone) Lose(l);
}

void ReplicaMerger::Lose(const LostBody& lost) {
  bodies_.erase(lost.body);
  transits_.erase(lost.body);
  lost_.push_back(lost);
}

}  // namespace aureole::client
