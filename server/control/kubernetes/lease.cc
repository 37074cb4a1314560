#include "server/control/kubernetes/lease.h"

namespace aureole::kubernetes {

Lease LeaseOf(const Json& object) {
  Lease lease;
  lease.holder = TextAt(object, {"spec", "holderIdentity"});
  lease.transitions = IntegerAt(object, {"spec", "leaseTransitions"}).value_or(0);
  lease.duration = std::chrono::seconds(IntegerAt(object, {"spec", "leaseDurationSeconds"}).value_or(0));
  lease.acquired = TextAt(object, {"spec", "acquireTime"});
  lease.renewed = TextAt(object, {"spec", "renewTime"});
  return lease;
}

void PutLease(const Lease& lease, Json* object) {
  Json& spec = (*object)["spec"];
  spec["holderIdentity"] = lease.holder;
  spec["leaseTransitions"] = lease.transitions;
  spec["leaseDurationSeconds"] = lease.duration.count();
  spec["acquireTime"] = lease.acquired;
  spec["renewTime"] = lease.renewed;
}

std::string MicroTime(absl::Time time) { return absl::FormatTime("%Y-%m-%dT%H:%M:%E6SZ", time, absl::UTCTimeZone()); }

}  // namespace aureole::kubernetes
