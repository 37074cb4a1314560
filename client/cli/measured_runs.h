// Runs on local region servers, measured, with their progress on stderr: what both tables of `aureole experiment` do.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include <absl/status/statusor.h>

#include "client/cli/measure.h"
#include "server/control/run.h"

namespace aureole {

// One run. `name` is what progress and errors call it; `region_server` the program to start, "" for aureole-region
// beside this one. Errors as of RunWorld; Cancelled after an interrupt, which must be caught already (CatchInterrupts).
absl::StatusOr<RunMeasure> MeasuredRun(const std::string& name, const RunOptions& run, int64_t tick_us,
                                       const std::string& region_server);
// `repeat` of them (>= 1), one after the other.
absl::StatusOr<std::vector<RunMeasure>> MeasuredRuns(const std::string& name, const RunOptions& run, int64_t tick_us,
                                                     int repeat, const std::string& region_server);

// What a command exits with after such runs: how they ended, how the results were written, and whether every split run
// gave the answer of the undivided one. Says on stderr what went wrong.
int ExitCode(const absl::Status& runs, const absl::Status& written, bool exact);

}  // namespace aureole
