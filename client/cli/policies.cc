#include "client/cli/policies.h"

#include <iostream>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <nlohmann/json.hpp>

#include "client/cli/crowd_world.h"
#include "client/cli/exit_codes.h"
#include "client/cli/measured_runs.h"
#include "client/cli/output_directory.h"
#include "server/control/world_file.h"

namespace aureole {
namespace {

constexpr double kDensities[] = {0.05, 0.2, 0.5, 1};  // bodies/m^2
constexpr Tick kHashEvery = 100;
constexpr double kDefaultDuration = 20;  // s
constexpr int kRegions = 2;

class PolicyRuns {
 public:
  explicit PolicyRuns(const ExperimentOptions& options) : options_(options) {
    table_.seed = options.seed.value_or(1);
    table_.duration_s = options.duration_s > 0 ? options.duration_s : kDefaultDuration;
    table_.repeat = options.repeat;
  }

  // Stops at the first run that fails; what was measured until then is in the table.
  absl::Status RunAll() {
    for (const bool fast : {false, true}) {
      for (const double density : kDensities) {
        if (absl::Status s = Add({density, fast, table_.seed, TicksIn(table_.duration_s, kCrowdTickUs)}); !s.ok()) {
          return s;
        }
      }
    }
    return absl::OkStatus();
  }

  // InvalidArgument when the largest of the crowds could not run so long.
  absl::Status Check() const {
    const Tick ticks = TicksIn(table_.duration_s, kCrowdTickUs);
    return CheckWorld(CrowdWorld({1, true, table_.seed, ticks}));
  }

  const PolicyTable& table() const { return table_; }

 private:
  absl::Status Add(const Crowd& crowd) {
    const v1::WorldSpec world = CrowdWorld(crowd);
    const absl::StatusOr<std::vector<RunMeasure>> one = Run(world, "undivided", true);
    if (!one.ok()) return one.status();
    PolicyScene& scene = table_.scenes.emplace_back();
    scene.world = world.name();
    scene.density = crowd.density;
    scene.fast = crowd.fast;
    scene.ticks = crowd.ticks;
    scene.reference = MedianOf(*one);
    for (const ExchangeChoice& exchange : kExchangeChoices) {
      const absl::StatusOr<std::vector<RunMeasure>> split = Run(WithExchange(world, exchange), exchange.Name(), false);
      if (!split.ok()) return split.status();
      scene.runs.push_back({exchange, MedianOf(*split), CompareAll(*split, scene.reference, crowd.ticks)});
    }
    return absl::OkStatus();
  }

  absl::StatusOr<std::vector<RunMeasure>> Run(v1::WorldSpec world, const std::string& what, bool undivided) {
    const std::string name = absl::StrCat(world.name(), ", ", what);
    constexpr size_t kRuns = 2 * std::size(kDensities) * (1 + kExchangeChoices.size());
    std::cerr << absl::StrFormat("[%d/%d] %s\n", ++started_, kRuns, name);
    RunOptions run;
    run.world = std::move(world);
    run.regions = kRegions;
    run.undivided = undivided;
    run.no_real_time = true;
    run.last_tick = TicksIn(table_.duration_s, kCrowdTickUs);
    run.hash_every = kHashEvery;
    return MeasuredRuns(name, run, kCrowdTickUs, options_.repeat, options_.region_server);
  }

  const ExperimentOptions& options_;
  PolicyTable table_;
  int started_ = 0;
};

absl::Status WriteAll(const PolicyTable& table, const std::filesystem::path& directory) {
  absl::Status s = WriteText(directory / "policies.json", ToJson(table).dump(2) + "\n");
  s.Update(WriteText(directory / "policies.csv", ToCsv(table)));
  return s;
}

}  // namespace

v1::WorldSpec WithExchange(v1::WorldSpec world, const ExchangeChoice& exchange) {
  world.mutable_exchange()->set_delay(static_cast<uint32_t>(exchange.k));
  if (exchange.k > 0) {
    world.mutable_exchange()->set_policy(exchange.reach ? v1::ExchangeSpec::REACH : v1::ExchangeSpec::TOLERANCE);
  }
  return world;
}

int RunPolicies(const ExperimentOptions& options) {
  PolicyRuns runs(options);
  for (const absl::Status& s : {runs.Check(), MakeOutputDirectory(options.out)}) {
    if (s.ok()) continue;
    std::cerr << s.message() << '\n';
    return kExitBadInput;
  }
  const absl::Status status = runs.RunAll();
  const PolicyTable& table = runs.table();
  const absl::Status written = table.scenes.empty() ? absl::OkStatus() : WriteAll(table, options.out);
  if (options.json) {
    std::cout << ToJson(table).dump(2) << std::endl;
  } else if (!table.scenes.empty()) {
    std::cout << TableText(table) << "Written to " << options.out << std::endl;
  }
  return ExitCode(status, written, table.Exact());
}

}  // namespace aureole
