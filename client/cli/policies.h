// `aureole experiment --policies`: which exchange is best in which crowd, by real processes.
#pragma once

#include "client/cli/experiment.h"
#include "client/cli/policies_report.h"

namespace aureole {

// The same world, exchanged in this way.
v1::WorldSpec WithExchange(v1::WorldSpec world, const ExchangeChoice& exchange);

// Runs every crowd of the table undivided, then split in two under each exchange, as fast as the machine can, and
// writes policies.json and policies.csv. Returns an exit code. Signals must be caught already (CatchInterrupts).
int RunPolicies(const ExperimentOptions& options);

}  // namespace aureole
