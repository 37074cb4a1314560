// aureole-bench: measurements that decide design questions. Every one prints a state hash beside its times.
#include <cinttypes>
#include <cstdio>

#include <CLI/CLI.hpp>

#include "tests/bench/overhead.h"

int main(int argc, char** argv) {
  CLI::App app("Benchmarks of Aureole.");
  app.require_subcommand(1);
  bool json = false;
  aureole::OverheadOptions options;
  CLI::App* overhead = app.add_subcommand("overhead", "One region against stock Bullet float64 on the same heap.");
  overhead->add_flag("--json", json, "One JSON object instead of text");
  overhead->add_option("--bodies", options.bodies, "Bodies in the heap")->check(CLI::Range(1, 100000));
  overhead->add_option("--warm-up", options.warm_up, "Ticks before measuring")->check(CLI::Range(0, 1000000));
  overhead->add_option("--blocks", options.blocks, "Measured blocks of each world")->check(CLI::Range(1, 100000));
  overhead->add_option("--block", options.block, "Ticks of a block")->check(CLI::Range(1, 100000));
  CLI11_PARSE(app, argc, argv);

  const aureole::OverheadResult r = aureole::MeasureOverhead(options);
  const char* format =
      json ? "{\"ratio_median\": %.4f, \"ratio_quartiles\": [%.4f, %.4f], \"region_ms\": %.4f, \"stock_ms\": %.4f, "
             "\"bodies\": %d, \"region_contacts\": %" PRId64 ", \"stock_contacts\": %" PRId64
             ", \"blocks\": %d, \"block\": %d, \"state_hash\": \"%016" PRIx64 "\"}\n"
           : "region / stock Bullet: %.3f (quartiles %.3f to %.3f)\nCPU per tick: region %.3f ms, stock %.3f ms\n"
             "%d bodies; contact points: region %" PRId64 ", stock %" PRId64
             "; %d blocks of %d ticks each\nstate hash %016" PRIx64 "\n";
  std::printf(format, r.ratio_median, r.ratio_low, r.ratio_high, r.region_ms, r.stock_ms, options.bodies,
              r.region_contacts, r.stock_contacts, options.blocks, options.block, r.state_hash);
  return 0;
}
