// coordination.k8s.io/v1 Lease, as far as leader election uses it.
#pragma once

#include <chrono>
#include <cstdint>
#include <string>

#include <absl/time/time.h>

#include "server/control/kubernetes/json.h"

namespace aureole::kubernetes {

struct Lease {
  std::string holder;       // empty: released
  int64_t transitions = 0;  // our epoch: each leader's is greater than the one before
  std::chrono::seconds duration{0};
  std::string acquired, renewed;  // MicroTime; the holder's clock, so of no meaning to others but for equality
  friend bool operator==(const Lease&, const Lease&) = default;
};

// Missing fields are empty or 0.
Lease LeaseOf(const Json& object);

// Sets the fields of `spec` that Lease has and leaves all else as it is.
void PutLease(const Lease& lease, Json* object);

// "2006-01-02T15:04:05.000000Z": UTC, six digits always.
std::string MicroTime(absl::Time time);

}  // namespace aureole::kubernetes
