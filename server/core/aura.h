// Aura arithmetic: the paper's Eqs. 1-4, and ours (PROTOCOL.md section 1), in integer microseconds (P4).
#pragma once

#include <cstdint>
#include <string>

#include <absl/status/status.h>

#include "server/core/types.h"

namespace aureole {

// What an operator promises of the servers and the network. All > 0 except latency and skew, which may be 0.
struct Tolerances {
  double speed = 32;          // V_t, m/s
  int64_t frame_us = 15000;   // T_F
  int64_t latency_us = 2000;  // T_L
  int64_t skew_us = 0;        // T_skew: clock skew between servers
  int64_t tick_us = 16000;    // T_P
};

// The paper's own figures.
struct PaperAura {
  int64_t remote_us = 0;  // T_R, Eq. 1
  int64_t host_us = 0;    // T_H, Eq. 2
  int64_t total_us = 0;   // T_T, Eq. 3
  // R_a, Eq. 4, for an object of bounding radius `r` metres.
  double Radius(double r, double speed) const { return r + speed * static_cast<double>(total_us) * 1e-6; }
};
PaperAura ComputePaperAura(const Tolerances& t);

// The delay of the fixed-delay exchange, in ticks: ceil((T_F + T_L + T_skew) / T_P) (DESIGN.md section 3). At least 1.
int ExchangeDelay(const Tolerances& t);

// The margins of PROTOCOL.md section 1, for delay k >= 1 and chain number m >= 2. Lengths in steps of V_t T_P.
struct Margins {
  double predict = 0;    // D_pred: 3k-2 + 2k(m-2)
  double give_back = 0;  // D_ret: D_pred + 2k
  double project = 0;    // D_proj: D_ret + 2k
  int spawn_notice = 0;  // ticks: 3k-1 + k(m-2)
  int horizon = 0;       // H of the `reach` policy, ticks: 2k-1 + k(m-2)
};
Margins ComputeMargins(int k, int m);

}  // namespace aureole
