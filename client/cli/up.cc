#include "client/cli/up.h"

#include <unistd.h>

#include <cstdio>
#include <iostream>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <absl/strings/str_format.h>
#include <nlohmann/json.hpp>

#include "client/cli/exit_codes.h"
#include "client/cli/flags.h"
#include "client/cli/live_table.h"
#include "client/cli/viewer_process.h"
#include "server/control/interrupts.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/scaling_flags.h"
#include "server/control/world_file.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;
using Json = nlohmann::ordered_json;

constexpr std::chrono::milliseconds kRedrawEvery{200};
constexpr std::chrono::seconds kLineEvery{1};
constexpr Tick kDefaultHashEvery = 100;

// Shows a run while it goes on: a table in place on a terminal, else a line each second.
class Display {
 public:
  Display(Heading heading, bool quiet, std::string viewer)
      : heading_(std::move(heading)), quiet_(quiet), terminal_(isatty(STDOUT_FILENO)), viewer_(std::move(viewer)) {}

  // False when nobody reads on.
  bool Show(const RunStatus& status) {
    RunViewer(status);
    if (quiet_) return true;
    const auto now = Clock::now();
    if (now < next_ && status.stage != Stage::kFinished) return true;
    next_ = now + (terminal_ ? std::chrono::milliseconds(kRedrawEvery) : std::chrono::milliseconds(kLineEvery));
    if (terminal_) {
      std::vector<std::string> lines = TableLines(heading_, status);
      if (!viewer_says_.empty()) lines.push_back(viewer_says_);
      screen_.Draw(lines);
    } else {
      if (!viewer_says_.empty()) std::printf("%s\n", std::exchange(viewer_says_, "").c_str());
      if (status.stage >= Stage::kRunning && !std::exchange(named_, true)) {
        std::printf("%s\ncontrol plane %s\n", ServersLine(status).c_str(), status.control.c_str());
      }
      std::printf("%s\n", PlainLine(heading_, status).c_str());
    }
    return std::fflush(stdout) == 0;
  }

 private:
  // Starts it once there are servers.
  void RunViewer(const RunStatus& status) {
    if (viewer_.empty() || status.stage < Stage::kRunning) return;
    if (process_ == nullptr && viewer_says_.empty()) {
      absl::StatusOr<std::unique_ptr<ViewerProcess>> started =
          ViewerProcess::Start(viewer_, status.regions[0].endpoint);
      if (started.ok()) {
        process_ = *std::move(started);
      } else {
        viewer_says_ = std::string(started.status().message());
        viewer_.clear();
      }
    }
    if (process_ == nullptr) return;
    // Its address, or why there is none.
    const std::string said = process_->TakeLines();
    const size_t begin = said.find("viewer: "), from = begin == std::string::npos ? 0 : begin;
    const size_t end = said.find('\n', from);
    if (end != std::string::npos) viewer_says_ = said.substr(from, end - from);
  }

  const Heading heading_;
  const bool quiet_, terminal_;
  std::string viewer_, viewer_says_;
  std::unique_ptr<ViewerProcess> process_;
  bool named_ = false;  // the servers
  Screen screen_{stdout};
  Clock::time_point next_{};
};

Json RegionJson(const RegionStatus& r, size_t region) {
  const v1::Report& report = r.report;
  return {{"region", region},
          {"tick", report.tick()},
          {"bodies", report.bodies()},
          {"awake", report.awake()},
          {"frame_ms", {{"mean", r.frame.mean_ms()}, {"p99", r.frame.p99_ms()}, {"max", r.frame.max_ms()}}},
          {"auras_told", report.auras_told()},
          {"aura_updates", report.aura_updates()},
          {"aura_tests", report.aura_tests()},
          {"transfers", report.transfers()},
          {"touching_transfers", report.touching_transfers()},
          {"bodies_moved", report.bodies_moved()},
          {"home_crossings", report.home_crossings()},
          {"largest_cluster", report.largest_cluster()},
          {"frames_sent", report.frames_sent()},
          {"bytes_sent", report.bytes_sent()},
          {"waits", report.waits()},
          {"wait_s", static_cast<double>(report.wait_us()) * 1e-6},
          {"reconnects", report.reconnects()},
          {"refused_frames", report.refused_frames()},
          {"violations", report.violations()},
          {"metrics", r.metrics_endpoint}};
}

Json ResultJson(const Heading& heading, const UpOptions& options, const absl::Status& status, const RunResult& result) {
  int64_t violations = 0, transfers = 0;
  Json regions = Json::array(), hashes = Json::array(), broken = Json::array();
  for (size_t i = 0; i < result.status.regions.size(); ++i) {
    violations += result.status.regions[i].report.violations();
    transfers += result.status.regions[i].report.transfers();
    regions.push_back(RegionJson(result.status.regions[i], i));
  }
  for (const TickSum& sum : result.hashes) {
    if (!sum.complete()) continue;
    hashes.push_back({{"tick", sum.tick}, {"hash", absl::StrFormat("%016x", sum.hash)}, {"bodies", sum.bodies}});
  }
  for (const v1::Violation& v : result.violations) {
    broken.push_back(
        {{"tick", v.tick()}, {"own", v.own()}, {"foreign", v.foreign()}, {"depth_m", v.depth()}, {"speed", v.speed()}});
  }
  const Tick tick = result.status.MinTick();
  const double simulated = static_cast<double>(tick) * static_cast<double>(heading.tick_us) * 1e-6;
  return {{"world", heading.world},
          {"ok", status.ok()},
          {"message", std::string(status.message())},
          {"undivided", options.undivided},
          {"real_time", !options.no_real_time},
          {"tick", tick},
          {"simulated_s", simulated},
          {"wall_s", result.wall_seconds},
          {"bodies", result.status.Bodies()},
          {"awake", result.status.Awake()},
          {"transfers", transfers},
          {"violations", violations},
          {"regions", regions},
          {"hashes", hashes},
          {"violation_log", broken}};
}

std::string Summary(const Heading& heading, const RunResult& result) {
  const Tick tick = result.status.MinTick();
  std::string out = absl::StrFormat("%d ticks, %.1f s simulated in %.1f s; %d bodies", tick,
                                    static_cast<double>(tick) * static_cast<double>(heading.tick_us) * 1e-6,
                                    result.wall_seconds, result.status.Bodies());
  if (!result.hashes.empty() && result.hashes.back().complete()) {
    const TickSum& sum = result.hashes.back();
    absl::StrAppendFormat(&out, "; state hash %016x at tick %d", sum.hash, sum.tick);
  }
  return out;
}

}  // namespace

CLI::App* AddUp(CLI::App& app, UpOptions* o) {
  CLI::App* up = app.add_subcommand("up", "Run a world on region servers of this machine, and show it");
  up->add_option("world", o->world, "World file (JSON)")->required()->type_name("FILE");
  AddDuration(up, &o->duration_s, "Simulated time to run, such as 60s, 2m or 500ms; until Ctrl-C when not given");
  up->add_flag("--no-real-time", o->no_real_time, "As fast as it can, not at the world's tick");
  up->add_flag("--undivided", o->undivided, "One server for the whole world: the reference");
  up->add_option("--hash-every", o->hash_every,
                 "Ticks between hashes of the whole state; 0 for none. With --duration 100 when not given")
      ->check(CLI::NonNegativeNumber)
      ->type_name("TICKS");
  up->add_flag("--json", o->json, "Print one JSON object at the end and nothing else");
  up->add_flag("--verbose", o->verbose, "Repeat the servers' logs on stderr");
  up->add_option("--control", o->control,
                 "Where the control plane listens, for aureole world, resize and drain; port 0 is any")
      ->type_name("HOST:PORT")
      ->capture_default_str();
  up->add_option("--logs", o->logs, "Keep the servers' logs in this directory")->type_name("DIR");
  up->add_option("--data", o->data, "Keep the regions' checkpoints in this directory; beside the logs when not given")
      ->type_name("DIR");
  up->add_option("--checkpoint-every", o->checkpoint_s,
                 "Seconds of simulated time between checkpoints, from which a server that dies is replaced; 0 for none")
      ->check(CLI::Range(0.0, 3600.0))
      ->capture_default_str()
      ->type_name("SECONDS");
  AddScalingFlags(up, &o->scaling);
  up->add_option("--region-server", o->region_server, "Program to start; aureole-region beside this one when not given")
      ->type_name("FILE");
  up->add_option("--tls", o->tls,
                 "Directory with ca.crt, tls.crt and tls.key (aureole certificates): TLS; plain text when not given")
      ->type_name("DIR");
  up->add_option("--tokens", o->tokens, "File of the tokens that clients need (aureole token); none when not given")
      ->type_name("FILE");
  up->add_option("--viewer", o->viewer,
                 "Directory of the browser viewer (client/viewer): serves it, and prints its address")
      ->type_name("DIR");
  up->footer(std::string("Examples:\n"
                         "  aureole up tests/worlds/demo.json\n"
                         "  aureole up tests/worlds/paper/column-4.json --duration 60s --json > result.json\n"
                         "  aureole up tests/worlds/demo.json --regions 1..6 --awake-bodies 100 --down-after 20s\n"
                         "  aureole up tests/worlds/bridge.json --no-real-time --duration 2m --hash-every 10\n\n"
                         "Without --duration, Ctrl-C is the way to end it, and the exit code is 0.\n") +
             kExitCodesHelp);
  return up;
}

int Up(const UpOptions& options) {
  if (!options.viewer.empty() && !(options.tls.empty() && options.tokens.empty())) {
    std::cerr << "--viewer: knows neither TLS nor tokens; leave it out, or --tls and --tokens\n";
    return kExitBadInput;
  }
  const absl::StatusOr<WorldFile> file = OpenWorldFile(options.world);
  if (!file.ok()) {
    std::cerr << file.status().message() << '\n';
    return kExitBadInput;
  }
  absl::Status scales = CheckScalingFlags(options.scaling, file->world);
  if (options.scaling.on() && options.undivided) {
    scales =
        absl::InvalidArgumentError("--regions: an undivided world has one region; leave out --regions, or --undivided");
  }
  if (!scales.ok()) {
    std::cerr << scales.message() << '\n';
    return kExitBadInput;
  }
  Heading heading{file->world.name, file->world.environment.tick_us, 0};
  if (options.duration_s > 0) heading.last_tick = TicksIn(options.duration_s, heading.tick_us);

  RunOptions run;
  run.world = file->spec;
  run.regions = file->world.layout.size();
  run.listen = options.control;
  LayoutDesk layouts(file->world);
  if (!options.undivided) run.layouts = &layouts;
  run.scaling = options.scaling;
  run.undivided = options.undivided;
  run.no_real_time = options.no_real_time;
  run.last_tick = heading.last_tick;
  run.hash_every = options.hash_every >= 0 ? options.hash_every : heading.last_tick > 0 ? kDefaultHashEvery : 0;

  if (options.checkpoint_s > 0) run.checkpoint_every = TicksIn(options.checkpoint_s, heading.tick_us);

  run.security.tls = options.tls;
  run.security.tokens = options.tokens;
  LocalAllocator allocator({options.region_server, options.logs, options.verbose, options.data, FlagsOf(run.security)});
  Display display(heading, options.json, options.viewer);
  RunResult result;
  const absl::Status status = RunWorld(
      run, allocator, [&display](const RunStatus& now) { return display.Show(now) && Interrupts() == 0; }, &result,
      [](const RunEvent& event) { std::cerr << "aureole: " << TextOf(event) << '\n'; });

  if (options.json) {
    std::cout << ResultJson(heading, options, status, result).dump(2) << std::endl;
  } else if (result.status.stage >= Stage::kRunning) {
    std::printf("%s\n", Summary(heading, result).c_str());
  }
  if (absl::IsCancelled(status)) return heading.last_tick == 0 ? kExitOk : kExitInterrupted;
  if (!status.ok()) {
    std::cerr << "aureole: " << status.message() << '\n';
    return kExitFailed;
  }
  int64_t violations = 0;
  for (const RegionStatus& r : result.status.regions) violations += r.report.violations();
  if (violations > 0) {
    std::cerr << "aureole: the run was not exact: " << violations << " violations\n";
    return kExitFailed;
  }
  return kExitOk;
}

}  // namespace aureole
