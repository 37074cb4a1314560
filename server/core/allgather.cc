#include "server/core/allgather.h"

#include <algorithm>
#include <cmath>

namespace aureole {
namespace {

constexpr int kMostInOneRow = 5;  // from 6 on two hops need fewer messages

}  // namespace

Allgather::Allgather(int regions, RegionId self) {
  int rows = 1;
  if (regions > kMostInOneRow) rows = static_cast<int>(std::lround(std::sqrt(static_cast<double>(regions))));
  // Rows are runs of regions whose lengths differ by at most one. begin(rows) is the end of the last.
  const auto begin = [=](int i) { return static_cast<RegionId>(static_cast<int64_t>(regions) * i / rows); };
  const auto length = [=](int i) { return begin(i + 1) - begin(i); };
  // Who of row `from` passes it on to the region in this row and column: its own column, or, where a longer row has one
  // more, a column that differs from row to row.
  const auto source = [=](int from, int to, int column) {
    return begin(from) + (column < length(from) ? column : to % length(from));
  };
  int mine = 0;
  while (begin(mine + 1) <= self) ++mine;
  for (int r = 0; r < rows; ++r) {
    for (RegionId id = begin(r); id < begin(r + 1); ++id) {
      if (r == mine) {
        if (id != self) row.push_back(id);
      } else if (source(mine, r, id - begin(r)) == self) {
        targets.push_back(id);
      }
    }
    if (r != mine) sources.push_back(source(r, mine, self - begin(mine)));
  }
}

}  // namespace aureole
