// Two hops carry everything to everybody, in few messages.
#include "server/core/allgather.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <set>

namespace aureole {
namespace {

// Ids with holes, as after regions have left.
std::vector<RegionId> Members(int n) {
  std::vector<RegionId> out;
  for (int i = 0; i < n; ++i) out.push_back(3 * i + i % 2);
  return out;
}

TEST(Allgather, EveryRegionGetsWhatEveryRegionSaysOnce) {
  for (int n = 1; n <= 130; ++n) {
    const std::vector<RegionId> members = Members(n);
    std::map<RegionId, Allgather> all;
    for (RegionId r : members) all.emplace(r, Allgather(members, r));
    for (RegionId r : members) {
      std::multiset<RegionId> heard(all.at(r).row.begin(), all.at(r).row.end());
      for (RegionId source : all.at(r).sources) {
        heard.insert(source);
        heard.insert(all.at(source).row.begin(), all.at(source).row.end());
      }
      heard.insert(r);
      ASSERT_EQ(heard.size(), static_cast<size_t>(n)) << n << " regions, region " << r;
      for (RegionId q : members) ASSERT_EQ(heard.count(q), 1u) << n << " regions, " << q << " to " << r;
    }
  }
}

TEST(Allgather, BothEndsAgreeWhoSendsToWhom) {
  const auto has = [](const std::vector<RegionId>& list, RegionId r) {
    return std::binary_search(list.begin(), list.end(), r);
  };
  for (int n = 1; n <= 40; ++n) {
    const std::vector<RegionId> members = Members(n);
    for (RegionId a : members) {
      const Allgather at_a(members, a);
      for (RegionId b : members) {
        const Allgather at_b(members, b);
        ASSERT_EQ(has(at_a.row, b), has(at_b.row, a)) << n << ": " << a << ", " << b;
        ASSERT_EQ(has(at_a.targets, b), has(at_b.sources, a)) << n << ": " << a << ", " << b;
      }
    }
  }
}

TEST(Allgather, MessagesGrowWithTheRootOfTheRegions) {
  for (int n = 6; n <= 400; ++n) {
    const std::vector<RegionId> members = Members(n);
    for (RegionId r : members) {
      const Allgather a(members, r);
      const double most = 2 * std::sqrt(static_cast<double>(n)) + 2;
      ASSERT_LE(static_cast<double>(a.row.size() + a.targets.size()), most) << n << " regions, region " << r;
      ASSERT_LE(static_cast<double>(a.row.size() + a.sources.size()), most) << n << " regions, region " << r;
    }
  }
}

}  // namespace
}  // namespace aureole
