#include "tests/bench/fan_out.h"

#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <vector>

#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "tests/bench/load_process.h"
#include "tests/bench/quantile.h"
#include "tests/bench/rolling.h"

namespace aureole {
namespace {

constexpr int64_t kTickUs = kRollingTickUs;
constexpr int64_t kWindowUs = 5'000'000;  // of the reports

}  // namespace

FanOutResult MeasureFanOut(const FanOutOptions& options) {
  const std::filesystem::path here = std::filesystem::read_symlink("/proc/self/exe").parent_path();
  const std::string program = options.aureole.empty() ? (here / "aureole").string() : options.aureole;
  RunOptions run;
  run.world = Rolling(options.bodies);
  const int64_t windows = 1 + 4 * int64_t{options.blocks};
  run.last_tick = windows * kWindowUs / kTickUs;
  LocalAllocator allocator({});
  RunResult result;
  std::unique_ptr<LoadProcess> load;
  const absl::Status end = RunWorld(
      run, allocator,
      [&](const RunStatus& status) {
        // Blocks of two windows; the first one of each is for coming and going, the second one counts.
        const int64_t window = status.MinTick() * kTickUs / kWindowUs;
        const bool wanted = status.stage == Stage::kRunning && window > 0 && (window - 1) / 2 % 2 == 1;
        if (wanted && load == nullptr)
          load = std::make_unique<LoadProcess>(program, status.regions[0].endpoint, options.clients, "3600s");
        if (!wanted) load.reset();
        return true;
      },
      &result);
  load.reset();
  FanOutResult out;
  if (!end.ok() || result.windows.empty()) {
    std::fprintf(stderr, "fan-out: %s\n", std::string(end.message()).c_str());
    return out;
  }
  std::vector<double> with_cores, base_cores, with_p99, base_p99;
  for (const v1::Window& w : result.windows[0]) {
    if (w.index() == 0 || w.index() % 2 == 1) continue;
    const bool with = (w.index() - 1) / 2 % 2 == 1;
    (with ? with_cores : base_cores).push_back(w.process_cpu().mean_ms() * 1e3 / kTickUs);
    (with ? with_p99 : base_p99).push_back(w.thread_cpu().p99_ms());
  }
  std::vector<double> cores, ratios;
  for (size_t i = 0; i < std::min(with_cores.size(), base_cores.size()); ++i) {
    cores.push_back(with_cores[i] - base_cores[i]);
    ratios.push_back(with_p99[i] / base_p99[i]);
  }
  out.ok = !cores.empty();
  out.cores = Median(cores);
  out.tick_p99_ratio = Median(ratios);
  out.tick_p99_ms = Median(base_p99);
  out.base_cores = Median(base_cores);
  return out;
}

}  // namespace aureole
