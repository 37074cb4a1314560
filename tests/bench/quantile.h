// Of measured values.
#pragma once

#include <algorithm>
#include <utility>
#include <vector>

namespace aureole {

// The value below which this share of them lies, interpolated; 0 of none.
inline double Quantile(std::vector<double> v, double share) {
  if (v.empty()) return 0;
  std::sort(v.begin(), v.end());
  const double at = share * static_cast<double>(v.size() - 1);
  const auto low = static_cast<size_t>(at);
  const double rest = at - static_cast<double>(low);
  return low + 1 < v.size() ? v[low] + rest * (v[low + 1] - v[low]) : v[low];
}

inline double Median(std::vector<double> v) { return Quantile(std::move(v), 0.5); }

}  // namespace aureole
