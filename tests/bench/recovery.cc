#include "tests/bench/recovery.h"

#include <algorithm>
#include <chrono>

#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/world_file.h"
#include "tests/e2e/killer.h"

namespace aureole {
namespace {

absl::Status RunUndivided(RunOptions options, RunResult* result) {
  options.undivided = options.no_real_time = true;
  options.regions = 1;
  options.checkpoint_every = 0;
  LocalAllocator allocator({});
  return RunWorld(
      options, allocator, [](const RunStatus&) { return true; }, result);
}

}  // namespace

RecoveryResult MeasureRecovery(const RecoveryOptions& options) {
  RecoveryResult out;
  const absl::StatusOr<WorldFile> file = OpenWorldFile(options.world);
  if (!file.ok()) {
    out.message = std::string(file.status().message());
    return out;
  }
  const int64_t tick_us = file->world.environment.tick_us;
  RunOptions run;
  run.world = file->spec;
  run.regions = file->world.layout.size();
  run.last_tick = TicksIn((options.kills + 5) * options.every_ms * 1e-3, tick_us);
  run.hash_every = 25;
  run.checkpoint_every = TicksIn(options.checkpoint_s, tick_us);

  Killer killer(options.seed, options.kills, std::chrono::milliseconds(options.every_ms));
  LocalAllocator allocator({});
  RunResult split, whole;
  absl::Status s = RunWorld(
      run, allocator,
      [&killer](const RunStatus& status) {
        killer.Look(status);
        return true;
      },
      &split);
  if (s.ok()) s = RunUndivided(run, &whole);
  out.message = std::string(s.message());
  out.killed = killer.killed();
  out.ticks = split.status.MinTick();
  out.bodies = split.status.Bodies();
  out.hashes = static_cast<int>(whole.hashes.size());
  for (size_t i = 0; i < std::min(whole.hashes.size(), split.hashes.size()); ++i) {
    const TickSum &a = whole.hashes[i], &b = split.hashes[i];
    out.equal += a.tick == b.tick && a.hash == b.hash && a.bodies == b.bodies;
  }
  out.longest_stop_s = killer.longest_stop().count();
  for (const RegionStatus& r : split.status.regions) {
    out.lost_s = std::max(out.lost_s, split.wall_seconds - static_cast<double>(out.ticks * tick_us) * 1e-6);
    out.checkpoints += r.report.checkpoints();
    out.checkpoint_kb = std::max(out.checkpoint_kb, static_cast<double>(r.report.checkpoint_bytes()) / 1e3);
    out.write_ms = std::max(out.write_ms, r.report.checkpoint_write_ms());
    out.pause_ms = std::max(out.pause_ms, r.report.checkpoint_pause_ms());
  }
  out.ok = s.ok() && out.equal == out.hashes;
  return out;
}

}  // namespace aureole
