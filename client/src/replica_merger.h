// One world from the streams of all its servers: each body once, by its epoch, however its servers' frames overtake
// each other, and while servers come and go.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <unordered_map>
#include <unordered_set>
#include <vector>

#include "client/src/replica_decoder.h"

namespace aureole::client {

struct MergedBody {
  int32_t region = -1;  // whose stream told it
  int64_t tick = 0;     // when the state was told or, of a body at rest, last changed
  ToldBody state;
  // States before, the latest first, each with the last tick at which it is known to have held; tick 0: none.
  struct Before {
    int64_t tick = 0;
    ToldBody state;
  };
  std::array<Before, 4> before{};
};

class ReplicaMerger {
 public:
  // From here on these regions are the world, by the layout of this epoch; no frame of another one comes. Called before
  // the first frame, and when servers have come or gone. What one that has left told stays as it was until another
  // region tells it, or all have told everything and none has it.
  void Follow(uint64_t layout_epoch, const std::vector<int32_t>& regions);
  // After `decoder`, of this region's stream, has taken this frame. A new stream may begin at any time: what the old
  // one told and the new one does not have stays like that of a region that has left.
  void Apply(int32_t region, const ReplicaDecoder& decoder, const v1::ReplicaFrame& frame);

  const std::unordered_map<uint64_t, MergedBody>& bodies() const { return bodies_; }
  // Of the last Apply: bodies that are gone from the merged world.
  const std::vector<LostBody>& lost() const { return lost_; }

 private:
  // A body that its server handed over and whose new server has not told it yet: it stays as it was.
  struct Transit {
    int32_t region = -1;
    uint32_t epoch = 0;
    int64_t tick = 0;
  };
  struct Told {
    int64_t tick = 0;  // of the last frame
    uint64_t layout_epoch = 0;
    // Of the present stream: the first and the last tick at which it had told all that is in view.
    std::optional<int64_t> whole_since, whole;
  };
  void Take(int32_t region, const ReplicaDecoder& decoder, uint64_t body);
  void HandOver(int32_t region, const v1::ReplicaFrame& frame, const LostBody& lost);
  void Settle(int32_t region, const ReplicaDecoder& decoder);
  void Reconcile(int32_t region, const ReplicaDecoder& decoder);
  void LoseOrphans();
  void Orphan(uint64_t body);
  void Lose(const LostBody& lost);
  void ForgetRemoved();

  std::unordered_map<uint64_t, MergedBody> bodies_;
  std::unordered_map<uint64_t, Transit> transits_;
  // Bodies of which no stream can say where they are now: the one that would have said it has ended.
  std::unordered_set<uint64_t> orphans_;
  std::optional<int64_t> settles_at_;  // who is an orphan still when all regions have told this tick is gone
  uint64_t layout_epoch_ = 0;
  std::unordered_map<int32_t, Told> regions_;
  // Bodies that were removed, and when: a frame of another region that comes late may still tell of them.
  std::unordered_map<uint64_t, int64_t> removed_;
  std::vector<LostBody> lost_;
};

}  // namespace aureole::client
