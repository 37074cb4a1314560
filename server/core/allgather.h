// How every region gets what every region has to say, in few messages: two hops through a virtual grid. Each region
// tells its row; then it passes on what it knows of its row to one region of each other row. About 2 sqrt(n) messages
// per region instead of n - 1, at the price of a second hop. A handful of regions is one row: everybody tells
// everybody.
#pragma once

#include <vector>

#include "server/core/types.h"

namespace aureole {

struct Allgather {
  // `members`, ascending, are those that take part; `self` is one of them.
  Allgather(const std::vector<RegionId>& members, RegionId self);

  std::vector<RegionId> row;      // the others of the own row: first hop, both ways; ascending
  std::vector<RegionId> targets;  // second hop: who gets the row from this region; ascending
  std::vector<RegionId> sources;  // second hop: who sends its row here, one of each other row; ascending
};

}  // namespace aureole
