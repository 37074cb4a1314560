// The physics tests, and two more modes: `--soak=TICKS [--soak-seeds=N] [--soak-first=S]` runs long split worlds, and
// `--print-hash` prints the hash of a short run, for comparison between CPUs.
#include <cinttypes>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <string_view>

#include <gtest/gtest.h>

#include "tests/physics/main.h"
#include "tests/physics/split_run.h"

namespace aureole {
namespace {

std::string g_executable;  // NOLINT: fixed before the first test

int Soak(Tick ticks, uint64_t first, uint64_t seeds) {
  int failures = 0;
  for (uint64_t seed = first; seed < first + seeds; ++seed) {
    SplitOptions o;
    o.engines = 2 + static_cast<int>(seed % 4);
    o.seed = seed;
    const SplitResult r = RunSplit(MakePhysicsScene(seed, 16, 18, ticks), ticks, o);
    std::printf("seed %" PRIu64 ", %d engines, %" PRId64 " ticks: %s; %" PRId64 " moves, %" PRId64
                " of touching components, largest %" PRId64 ", asleep %.0f %%, %" PRId64 " wakes, hash %016" PRIx64
                "\n",
                seed, o.engines, ticks, r.difference.empty() ? "equal" : r.difference.c_str(), r.moves, r.touching,
                r.largest, 100.0 * static_cast<double>(r.asleep) / static_cast<double>(r.body_ticks), r.wakes, r.hash);
    std::fflush(stdout);
    failures += r.difference.empty() ? 0 : 1;
  }
  return failures == 0 ? 0 : 1;
}

}  // namespace

const std::string& TestExecutable() { return g_executable; }

}  // namespace aureole

int main(int argc, char** argv) {
  aureole::g_executable = argv[0];
  aureole::Tick ticks = 0;
  uint64_t seeds = 1, first = 1;
  for (int i = 1; i < argc; ++i) {
    const std::string arg = argv[i];
    if (arg == "--print-hash") {
      std::printf("%016" PRIx64 "\n", aureole::RunAlone(aureole::MakePhysicsScene(5, 6, 12, 300), 300));
      return 0;
    }
    if (arg.starts_with("--soak=")) ticks = std::atoll(arg.c_str() + 7);
    if (arg.starts_with("--soak-seeds=")) seeds = std::strtoull(arg.c_str() + 13, nullptr, 10);
    if (arg.starts_with("--soak-first=")) first = std::strtoull(arg.c_str() + 13, nullptr, 10);
  }
  if (ticks > 0) return aureole::Soak(ticks, first, seeds);
  testing::InitGoogleTest(&argc, argv);
  return RUN_ALL_TESTS();
}
