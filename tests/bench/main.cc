// aureole-bench: measurements that decide design questions. Every one prints a state hash beside its figures.
#include <cinttypes>
#include <cstdio>

#include <CLI/CLI.hpp>

#include "tests/bench/checkpoint_cost.h"
#include "tests/bench/client_bytes.h"
#include "tests/bench/fan_out.h"
#include "tests/bench/overhead.h"
#include "tests/bench/recovery.h"
#include "tests/bench/stopped_clients.h"
#include "tests/bench/view_cost.h"

namespace aureole {
namespace {

void PrintOverhead(const OverheadOptions& options, bool json) {
  const OverheadResult r = MeasureOverhead(options);
  const char* format =
      json ? "{\"ratio_median\": %.4f, \"ratio_quartiles\": [%.4f, %.4f], \"region_ms\": %.4f, \"stock_ms\": %.4f, "
             "\"bodies\": %d, \"region_contacts\": %" PRId64 ", \"stock_contacts\": %" PRId64
             ", \"blocks\": %d, \"block\": %d, \"state_hash\": \"%016" PRIx64 "\"}\n"
           : "region / stock Bullet: %.3f (quartiles %.3f to %.3f)\nCPU per tick: region %.3f ms, stock %.3f ms\n"
             "%d bodies; contact points: region %" PRId64 ", stock %" PRId64
             "; %d blocks of %d ticks each\nstate hash %016" PRIx64 "\n";
  std::printf(format, r.ratio_median, r.ratio_low, r.ratio_high, r.region_ms, r.stock_ms, options.bodies,
              r.region_contacts, r.stock_contacts, options.blocks, options.block, r.state_hash);
}

void PrintCheckpointCost(const CheckpointCostOptions& options, bool json) {
  const CheckpointCostResult r = MeasureCheckpointCost(options);
  std::printf(
      json ? "{\"pause_ms\": %.4f, \"longest_ms\": %.4f, \"tick_ms\": %.4f, \"kilobytes\": %.1f, \"bodies\": %d, "
             "\"contacts\": %" PRId64 ", \"state_hash\": \"%016" PRIx64 "\"}\n"
           : "taking a checkpoint: %.3f ms of the tick thread's CPU, at most %.3f; a tick: %.3f ms\n"
             "%.0f kB; %d awake bodies, %" PRId64 " contact points\nstate hash %016" PRIx64 "\n",
      r.pause_ms, r.longest_ms, r.tick_ms, r.kilobytes, options.bodies, r.contacts, r.state_hash);
}

void PrintClientBytes(const ClientBytesOptions& options, bool json) {
  const ClientBytesResult r = MeasureClientBytes(options);
  if (json) std::printf("{\"rows\": [");
  if (!json) std::printf("scene        encoding  every  moving  bytes/body/frame   kbit/s\n");
  const char* separator = "";
  for (const ClientBytesRow& row : r.rows) {
    if (json) {
      std::printf(
          "%s{\"scene\": \"%s\", \"encoding\": \"%s\", \"period\": %d, \"moving\": %.4f, \"bytes_per_body\": %.4f, "
          "\"kbit_per_s\": %.1f}",
          separator, row.scene.c_str(), row.encoding.c_str(), row.period, row.moving, row.bytes_per_body,
          row.kbit_per_s);
      separator = ", ";
    } else {
      std::printf("%-12s %-8s %6d  %5.1f%%  %16.3f %8.1f\n", row.scene.c_str(), row.encoding.c_str(), row.period,
                  100 * row.moving, row.bytes_per_body, row.kbit_per_s);
    }
  }
  std::printf(json ? "], \"quiet_seconds\": %d, \"quiet_kbit_per_s\": %.1f, \"state_hash\": \"%016" PRIx64 "\"}\n"
                   : "901 cubes, seconds in which at most 4 %% move: %d, at most %.1f kbit/s\nstate hash %016" PRIx64
                     "\n",
              r.quiet_seconds, r.quiet_kbit_per_s, r.state_hash);
}

int PrintFanOut(const FanOutOptions& options, bool json) {
  const FanOutResult r = MeasureFanOut(options);
  if (!r.ok) return 1;
  std::printf(json
                  ? "{\"clients\": %d, \"bodies\": %d, \"cores\": %.4f, \"tick_p99_ratio\": %.4f, "
                    "\"tick_p99_ms\": %.4f, \"base_cores\": %.4f}\n"
                  : "%d clients of one view of %d moving bodies at 60 Hz cost %.3f cores of the region server\n"
                    "tick thread, p99: %.3f of what it is without them (%.3f ms; server without clients: %.3f cores)\n",
              options.clients, options.bodies, r.cores, r.tick_p99_ratio, r.tick_p99_ms, r.base_cores);
  return 0;
}

int PrintStopped(const StoppedClientsOptions& options, bool json) {
  const StoppedClientsResult r = MeasureStoppedClients(options);
  if (!r.ok) return 1;
  std::printf(
      json ? "{\"clients\": %d, \"stopped\": %d, \"rate_before\": %.2f, \"rate_after\": %.2f, "
             "\"p99_before_ms\": %.2f, \"p99_after_ms\": %.2f, \"memory_before_mb\": %.1f, "
             "\"memory_after_mb\": %.1f}\n"
           : "%d clients, %d of them stopped: the slowest of the others gets %.1f frames/s before and %.1f after, "
             "p99 between frames %.1f and %.1f ms; memory of the server %.1f and %.1f MB\n",
      options.clients, options.stopped, r.rate_before, r.rate_after, r.p99_before_ms, r.p99_after_ms,
      r.memory_before_mb, r.memory_after_mb);
  return 0;
}

void PrintViewCost(const ViewCostOptions& options, bool json) {
  const ViewCostResult r = MeasureViewCost(options);
  std::printf(json ? "{\"bodies\": %d, \"in_view\": %d, \"large_us\": %.1f, \"large_tick_us\": %.1f, \"small_us\": "
                     "%.1f, \"small_tick_us\": %.1f, \"ratio\": %.3f, \"distinct_us\": %.1f}\n"
                   : "of %d moving bodies %d are in view: %.0f us of CPU per frame (tick thread: %.0f); in a world of "
                     "these alone %.0f us (%.0f): ratio %.2f\none more view of its own: %.0f us per frame\n",
              options.bodies, r.in_view, r.large_us, r.large_tick_us, r.small_us, r.small_tick_us, r.ratio,
              r.distinct_us);
}

int PrintRecovery(const RecoveryOptions& options, bool json) {
  const RecoveryResult r = MeasureRecovery(options);
  std::printf(
      json ? "{\"killed\": %d, \"ticks\": %" PRId64 ", \"bodies\": %" PRId64
             ", \"hashes\": %d, \"equal\": %d, \"longest_stop_s\": %.3f, \"lost_s\": %.3f, \"checkpoints\": "
             "%" PRId64 ", \"checkpoint_kb\": %.1f, \"write_ms\": %.2f, \"pause_ms\": %.3f}\n"
           : "%d servers killed in %" PRId64 " ticks, %" PRId64
             " bodies\nhashes: %d, equal to the undivided world's: %d\nlongest stop of the world: %.2f s; behind "
             "the wall clock at the end: %.2f s\n%" PRId64
             " checkpoints, at most %.0f kB, written in %.1f ms; the tick paused for at most %.2f ms\n",
      r.killed, r.ticks, r.bodies, r.hashes, r.equal, r.longest_stop_s, r.lost_s, r.checkpoints, r.checkpoint_kb,
      r.write_ms, r.pause_ms);
  if (!r.ok) std::fprintf(stderr, "%s\n", r.message.empty() ? "the hashes differ" : r.message.c_str());
  return r.ok ? 0 : 1;
}

int Run(int argc, char** argv) {
  CLI::App app("Benchmarks of Aureole.");
  app.require_subcommand(1);
  bool json = false;
  OverheadOptions overhead_options;
  CLI::App* overhead = app.add_subcommand("overhead", "One region against stock Bullet float64 on the same heap.");
  overhead->add_flag("--json", json, "One JSON object instead of text");
  overhead->add_option("--bodies", overhead_options.bodies, "Bodies in the heap")->check(CLI::Range(1, 100000));
  overhead->add_option("--warm-up", overhead_options.warm_up, "Ticks before measuring")->check(CLI::Range(0, 1000000));
  overhead->add_option("--blocks", overhead_options.blocks, "Measured blocks of each world")
      ->check(CLI::Range(1, 100000));
  overhead->add_option("--block", overhead_options.block, "Ticks of a block")->check(CLI::Range(1, 100000));
  ClientBytesOptions bytes_options;
  CLI::App* bytes = app.add_subcommand("clients", "Bytes of replicas per body and frame, poses only, precision FINE.");
  bytes->add_flag("--json", json, "One JSON object instead of text");
  bytes->add_option("--bodies", bytes_options.bodies, "Bodies of a scene")->check(CLI::Range(1, 100000));
  bytes->add_option("--ticks", bytes_options.ticks, "Measured ticks of a scene")->check(CLI::Range(60, 1000000));
  CheckpointCostOptions checkpoint_options;
  CLI::App* checkpoint = app.add_subcommand("checkpoint", "What taking a checkpoint costs the tick thread.");
  checkpoint->add_flag("--json", json, "One JSON object instead of text");
  checkpoint->add_option("--bodies", checkpoint_options.bodies, "Awake bodies")->check(CLI::Range(1, 100000));
  checkpoint->add_option("--checkpoints", checkpoint_options.checkpoints, "Checkpoints")->check(CLI::Range(1, 100000));
  FanOutOptions fan_out_options;
  CLI::App* fan_out = app.add_subcommand("fan-out", "Clients that share one view, on real processes.");
  fan_out->add_flag("--json", json, "One JSON object instead of text");
  fan_out->add_option("--clients", fan_out_options.clients, "Clients")->check(CLI::Range(1, 10000));
  fan_out->add_option("--bodies", fan_out_options.bodies, "Bodies in view")->check(CLI::Range(1, 100000));
  fan_out->add_option("--blocks", fan_out_options.blocks, "Blocks of 10 s with and without clients")
      ->check(CLI::Range(1, 1000));
  StoppedClientsOptions stopped_options;
  CLI::App* stopped = app.add_subcommand("stopped", "Clients that stop reading, beside others, on real processes.");
  stopped->add_flag("--json", json, "One JSON object instead of text");
  stopped->add_option("--clients", stopped_options.clients, "Clients")->check(CLI::Range(2, 10000));
  stopped->add_option("--stopped", stopped_options.stopped, "Clients that stop")->check(CLI::Range(1, 9999));
  ViewCostOptions view_options;
  CLI::App* view = app.add_subcommand("view", "A view of a small part of a large world, and views of their own.");
  view->add_flag("--json", json, "One JSON object instead of text");
  view->add_option("--bodies", view_options.bodies, "Bodies of the large world")->check(CLI::Range(2000, 1000000));
  view->add_option("--frames", view_options.frames, "Measured frames")->check(CLI::Range(4, 100000));
  RecoveryOptions recovery_options;
  CLI::App* recovery = app.add_subcommand("recovery", "Servers killed at random moments, on real processes.");
  recovery->add_flag("--json", json, "One JSON object instead of text");
  recovery->add_option("--world", recovery_options.world, "World file")->check(CLI::ExistingFile);
  recovery->add_option("--kills", recovery_options.kills, "SIGKILLs")->check(CLI::Range(1, 100000));
  recovery->add_option("--every", recovery_options.every_ms, "Milliseconds between them, on average")
      ->check(CLI::Range(50, 100000));
  recovery->add_option("--seed", recovery_options.seed, "Of the moments and the servers");
  recovery->add_option("--checkpoint-every", recovery_options.checkpoint_s, "Seconds between checkpoints")
      ->check(CLI::Range(0.016, 3600.0));
  CLI11_PARSE(app, argc, argv);
  if (recovery->parsed()) return PrintRecovery(recovery_options, json);
  if (overhead->parsed()) PrintOverhead(overhead_options, json);
  if (checkpoint->parsed()) PrintCheckpointCost(checkpoint_options, json);
  if (bytes->parsed()) PrintClientBytes(bytes_options, json);
  if (view->parsed()) PrintViewCost(view_options, json);
  if (stopped->parsed()) return PrintStopped(stopped_options, json);
  if (fan_out->parsed()) return PrintFanOut(fan_out_options, json);
  return 0;
}

}  // namespace
}  // namespace aureole

int main(int argc, char** argv) { return aureole::Run(argc, argv); }
