// Two hops carry everything to everybody, in few messages.
#include "server/core/allgather.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <set>

namespace aureole {
namespace {

TEST(Allgather, EveryRegionGetsWhatEveryRegionSaysOnce) {
  for (int n = 1; n <= 130; ++n) {
    std::vector<Allgather> all;
    for (RegionId r = 0; r < n; ++r) all.emplace_back(n, r);
    for (RegionId r = 0; r < n; ++r) {
      std::multiset<RegionId> heard(all[r].row.begin(), all[r].row.end());
      for (RegionId source : all[r].sources) {
        heard.insert(source);
        heard.insert(all[source].row.begin(), all[source].row.end());
      }
      heard.insert(r);
      ASSERT_EQ(heard.size(), static_cast<size_t>(n)) << n << " regions, region " << r;
      for (RegionId q = 0; q < n; ++q) ASSERT_EQ(heard.count(q), 1u) << n << " regions, " << q << " to " << r;
    }
  }
}

TEST(Allgather, BothEndsAgreeWhoSendsToWhom) {
  const auto has = [](const std::vector<RegionId>& list, RegionId r) {
    return std::binary_search(list.begin(), list.end(), r);
  };
  for (int n = 1; n <= 40; ++n) {
    for (RegionId a = 0; a < n; ++a) {
      const Allgather at_a(n, a);
      for (RegionId b = 0; b < n; ++b) {
        const Allgather at_b(n, b);
        ASSERT_EQ(has(at_a.row, b), has(at_b.row, a)) << n << ": " << a << ", " << b;
        ASSERT_EQ(has(at_a.targets, b), has(at_b.sources, a)) << n << ": " << a << ", " << b;
      }
    }
  }
}

TEST(Allgather, MessagesGrowWithTheRootOfTheRegions) {
  for (int n = 6; n <= 400; ++n) {
    for (RegionId r = 0; r < n; ++r) {
      const Allgather a(n, r);
      const double most = 2 * std::sqrt(static_cast<double>(n)) + 2;
      ASSERT_LE(static_cast<double>(a.row.size() + a.targets.size()), most) << n << " regions, region " << r;
      ASSERT_LE(static_cast<double>(a.row.size() + a.sources.size()), most) << n << " regions, region " << r;
    }
  }
}

}  // namespace
}  // namespace aureole
