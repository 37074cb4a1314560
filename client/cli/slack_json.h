// How the slack at first touch is written in every JSON.
#pragma once

#include <nlohmann/json.hpp>

#include "client/cli/measure.h"

namespace aureole {

// In ticks; null when nobody met anybody.
inline nlohmann::ordered_json SlackJson(const RunMeasure& m) {
  const std::optional<SlackQuantiles> q = QuantilesOf(m.slack);
  if (!q) return nullptr;
  return {{"met", q->met}, {"never", q->never}, {"min", q->min}, {"p1", q->p1}, {"p50", q->p50}, {"p99", q->p99}};
}

}  // namespace aureole
