// One world from the streams of all its servers: each body once, by its epoch, however its servers' frames overtake
// each other.
#pragma once

#include <array>
#include <cstdint>
#include <unordered_map>
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
  // After `decoder`, of this region's stream, has taken a frame. `more`: that frame did not hold all that is in view.
  void Apply(int32_t region, const ReplicaDecoder& decoder, bool more = false);
  // After a new stream to this region has told all that is in view: what the old one told and the new one does not have
  // is gone.
  void Reconcile(int32_t region, const ReplicaDecoder& decoder);

  const std::unordered_map<uint64_t, MergedBody>& bodies() const { return bodies_; }
  // Of the last Apply or Reconcile: bodies that are gone from the merged world.
  const std::vector<LostBody>& lost() const { return lost_; }

 private:
  // A body that its server handed over and whose new server has not told it yet: it stays as it was.
  struct Transit {
    int32_t region = -1;
    uint32_t epoch = 0;
    int64_t tick = 0;
  };
  void Settle(int32_t region, const ReplicaDecoder& decoder);
  void Lose(const LostBody& lost);
  void ForgetRemoved();

  std::unordered_map<uint64_t, MergedBody> bodies_;
  std::unordered_map<uint64_t, Transit> transits_;
  std::unordered_map<int32_t, int64_t> ticks_;  // of each region's last frame
  // Bodies that were removed, and when: a frame of another region that comes late may still tell of them.
  std::unordered_map<uint64_t, int64_t> removed_;
  std::vector<LostBody> lost_;
};

}  // namespace aureole::client
