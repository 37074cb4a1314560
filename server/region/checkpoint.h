// What a region leaves behind for the case that it dies: its state after a tick, and what its links keep. With the
// frames of its peers and the inputs logged after it (journal.h) it is everything that decides the region's future.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include <absl/status/statusor.h>

#include "server/core/region.h"
#include "server/core/types.h"
#include "server/region/region_links.h"
#include "server/transport/peer_link.h"

namespace aureole {

struct Checkpoint {
  struct Hash {
    Tick tick = 0;
    uint64_t hash = 0;
    int64_t bodies = 0;
    int32_t members = 1;  // regions that have a part of this tick

    template <class Archive>
    void Visit(Archive& a) {
      a(tick, hash, bodies, members);
    }
  };

  uint64_t world_hash = 0;
  RegionId region = kNoRegion;
  Tick tick = 0;      // after which it was taken
  std::string state;  // Region::Save
  std::map<RegionId, LinkState> links;
  std::vector<Hash> hashes;  // of the ticks just before, which may not have been reported
};

// Of a region after a tick, at the beginning of the next or when it has left. `room`: what it held is lost, and its
// memory is used, which is much faster than new memory.
Checkpoint TakeCheckpoint(uint64_t world_hash, const Region& region, const RegionLinks& links, std::string room = {});

// With a check sum. Linear; tens of megabytes for the largest regions, so not for the tick thread.
std::string EncodeCheckpoint(const Checkpoint& checkpoint);
// DataLoss when the bytes are not what EncodeCheckpoint of this program wrote.
absl::StatusOr<Checkpoint> DecodeCheckpoint(std::string_view bytes);

}  // namespace aureole
