#include "server/core/aura.h"

#include <algorithm>

namespace aureole {
namespace {

int64_t CeilDiv(int64_t a, int64_t b) { return (a + b - 1) / b; }

}  // namespace

PaperAura ComputePaperAura(const Tolerances& t) {
  // One leg: up to a frame before the send, the latency, up to a frame until it is acted upon; rounding up to the step
  // is meant to cover the detection.
  const int64_t leg = CeilDiv(2 * t.frame_us + t.latency_us, t.tick_us) * t.tick_us;
  PaperAura a;
  a.remote_us = leg;                     // Eq. 1
  a.host_us = leg - t.tick_us + leg;     // Eq. 2
  a.total_us = a.remote_us + a.host_us;  // Eq. 3: (3 ceil(...) - 1) T_P
  return a;
}

int ExchangeDelay(const Tolerances& t) {
  return static_cast<int>(std::max<int64_t>(1, CeilDiv(t.frame_us + t.latency_us + t.skew_us, t.tick_us)));
}

Margins ComputeMargins(int k, int m) {
  const int legs = std::max(0, m - 2);
  Margins r;
  // Two bodies approach, each by a step a tick: k ticks until the decider knows (2k steps), k-1 more in flight; one
  // further leg of k ticks for each rank that the cluster may have to be forwarded to.
  r.predict = 3 * k - 2 + 2 * k * legs;
  r.give_back = r.predict + 2 * k;
  r.project = r.give_back + 2 * k;
  r.spawn_notice = 3 * k - 1 + k * legs;
  r.horizon = 2 * k - 1 + k * legs;
  return r;
}

}  // namespace aureole
