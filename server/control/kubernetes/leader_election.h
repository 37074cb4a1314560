// Who leads, decided by one Lease. A pure state machine: it is told what was read and written and when, and says what
// to do next; leader_elector.h does it.
//
// Everybody measures on a clock of its own. A candidate takes the lease when it is released, when its holder is the
// candidate itself, or when it has not changed for its duration since the candidate saw it change. A leader may act
// until `renew_deadline` after it *sent* the last renewal that succeeded; the others wait for longer than that, from
// the time when they saw it. So no two lead at once as long as their clocks run equally fast within deadline :
// duration.
//
// That does not reach a command that is on its way, or a process that is stopped between the question and the act. For
// these the epoch (leaseTransitions) goes with every command, and who has seen a higher one refuses it. An epoch is one
// unbroken time of leading of one process.
#pragma once

#include <chrono>
#include <cstdint>
#include <optional>
#include <string>

#include <absl/status/status.h>

#include "server/control/kubernetes/boot_clock.h"
#include "server/control/kubernetes/lease.h"

namespace aureole::kubernetes {

struct ElectionTiming {
  std::chrono::milliseconds duration{15000};        // of the lease; written in whole seconds, rounded up
  std::chrono::milliseconds renew_deadline{10000};  // less than `duration`
  std::chrono::milliseconds retry{2000};            // between renewals, and between looks of a candidate
};

// InvalidArgument, with the field, unless 0 < retry < renew_deadline < duration.
absl::Status CheckTiming(const ElectionTiming& timing);

class LeaderElection {
 public:
  using Time = BootClock::time_point;

  // `identity` must be that of this process only: another one of the same name would take its lease at once. A timing
  // that CheckTiming refuses stops the process.
  LeaderElection(std::string identity, ElectionTiming timing);

  enum class Action : uint8_t {
    kWait,     // until `at`
    kRead,     // the lease; then Read
    kCreate,   // `lease`; then Written, Refused or Failed
    kReplace,  // likewise, by the resourceVersion of the last lease read or written
  };
  struct Step {
    Action action = Action::kWait;
    Time at;      // of kWait
    Lease lease;  // without `renewed`, and without `acquired` when that is to be set to now
  };
  // What to do at `now`. Never goes back in time.
  Step Next(Time now);

  // What came of it, at `now`. A lease was read, or there is none.
  void Read(Time now, const std::optional<Lease>& lease);
  // The write of `lease` succeeded; `sent`: when its request was begun, at the latest.
  void Written(Time sent, Time now, const Lease& lease);
  // The lease is not what we thought (a conflict, already there, not found): nothing was written.
  void Refused(Time now);
  // Nothing is known: it may have been done or not.
  void Failed(Time now);

  // Stops leading; the next step releases the lease when we held it. For the end only.
  void Resign();

  // The epoch when we may act at `now`. Any later time may have another answer: ask before each act.
  std::optional<int64_t> Epoch(Time now) const;
  // Until when that holds when nothing is renewed. Of no meaning when we do not lead.
  Time until() const { return renewed_at_ + timing_.renew_deadline; }
  // As last seen; empty: nobody.
  std::string holder() const { return seen_ ? seen_->holder : ""; }
  const std::string& identity() const { return identity_; }

 private:
  void See(Time now, const Lease& lease);
  Lease OwnLease(int64_t transitions, const std::string& acquired) const;
  std::chrono::milliseconds Patience() const;

  const std::string identity_;
  const ElectionTiming timing_;
  std::optional<Lease> seen_;  // the lease as last read or written
  Time seen_at_;               // when we saw it change
  bool fresh_ = false;         // seen_ may be written over; false: read first
  int64_t highest_ = 0;        // of all transitions seen, also of leases that were deleted
  bool leads_ = false;         // until `until()`
  Time renewed_at_;
  Time next_at_;  // nothing to do before
  bool resigned_ = false;
};

}  // namespace aureole::kubernetes
