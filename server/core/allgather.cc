#include "server/core/allgather.h"

#include <algorithm>
#include <cmath>

namespace aureole {
namespace {

constexpr int kMostInOneRow = 5;  // from 6 on two hops need fewer messages

}  // namespace

Allgather::Allgather(const std::vector<RegionId>& members, RegionId self) {
  const int regions = static_cast<int>(members.size());
  const int place = static_cast<int>(std::lower_bound(members.begin(), members.end(), self) - members.begin());
  int rows = 1;
  if (regions > kMostInOneRow) rows = static_cast<int>(std::lround(std::sqrt(static_cast<double>(regions))));
  // In what follows a region is its place among the members. Rows are runs of regions whose lengths differ by at most
  // one. begin(rows) is the end of the last.
  const auto begin = [=](int i) { return static_cast<int>(static_cast<int64_t>(regions) * i / rows); };
  const auto length = [=](int i) { return begin(i + 1) - begin(i); };
  // Who of row `from` passes it on to the region in this row and column: its own column, or, where a longer row has one
  // more, a column that differs from row to row.
  const auto source = [=](int from, int to, int column) {
    return begin(from) + (column < length(from) ? column : to % length(from));
  };
  int mine = 0;
  while (begin(mine + 1) <= place) ++mine;
  for (int r = 0; r < rows; ++r) {
    for (int i = begin(r); i < begin(r + 1); ++i) {
      if (r == mine) {
        if (i != place) row.push_back(members[i]);
      } else if (source(mine, r, i - begin(r)) == place) {
        targets.push_back(members[i]);
      }
    }
    if (r != mine) sources.push_back(members[source(r, mine, place - begin(mine))]);
  }
}

}  // namespace aureole
