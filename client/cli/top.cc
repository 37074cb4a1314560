#include "client/cli/top.h"

#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <iostream>
#include <thread>

#include <nlohmann/json.hpp>

#include "client/cli/connect.h"
#include "client/cli/exit_codes.h"
#include "client/cli/flags.h"
#include "client/cli/layout_watch.h"
#include "client/cli/live_table.h"
#include "server/control/interrupts.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;
using Json = nlohmann::ordered_json;

Json StatusJson(const RunStatus& status) {
  Json regions = Json::array();
  for (size_t i = 0; i < status.regions.size(); ++i) {
    const RegionStatus& r = status.regions[i];
    if (!r.member) continue;
    regions.push_back(
        {{"region", i},
         {"server", r.endpoint},
         {"up", !r.left},
         {"tick", r.report.tick()},
         {"bodies", r.report.bodies()},
         {"awake", r.report.awake()},
         {"real_time_factor", r.report.real_time_factor()},
         {"frame_ms", {{"mean", r.frame.mean_ms()}, {"p99", r.frame.p99_ms()}, {"max", r.frame.max_ms()}}},
         {"auras", r.report.auras_told()},
         {"transfers", r.report.transfers()},
         {"bytes_per_second", r.bytes_per_second},
         {"waits", r.report.waits()},
         {"violations", r.report.violations()}});
  }
  return {{"tick", status.MinTick()}, {"bodies", status.Bodies()}, {"regions", regions}};
}

bool AllLeft(const RunStatus& status) {
  return std::all_of(status.regions.begin(), status.regions.end(), [](const RegionStatus& r) { return r.left; });
}

}  // namespace

CLI::App* AddTop(CLI::App& app, TopOptions* o) {
  CLI::App* c = app.add_subcommand("top", "How the region servers of a running world do");
  AddServer(c, &o->server);
  AddDuration(c, &o->duration_s, "Until interrupted when not given");
  c->add_flag("--json", o->json, "JSON, one object per second");
  c->footer(std::string("Examples:\n"
                        "  aureole top --server 127.0.0.1:40001\n"
                        "  aureole top --server 127.0.0.1:40001 --duration 5s --json\n\n") +
            kExitCodesHelp);
  return c;
}

int RunTop(const TopOptions& o) {
  std::string error;
  const std::unique_ptr<LayoutWatch> watch = LayoutWatch::Open(o.server, &error);
  if (watch == nullptr) {
    std::cerr << "--server " << o.server << ": no region server answers there (" << error << ")\n";
    return kExitBadInput;
  }
  const v1::GetWorldResponse world = watch->world();
  const Heading heading{world.name(), world.tick_us(), 0};
  const bool terminal = !o.json && isatty(STDOUT_FILENO) != 0;
  const auto every = terminal ? std::chrono::milliseconds(200) : std::chrono::milliseconds(1000);
  Screen screen(stdout);
  const Clock::time_point begin = Clock::now();
  for (Clock::time_point next = begin + every; Interrupts() == 0;
       std::this_thread::sleep_for(std::chrono::milliseconds(20))) {
    const Clock::time_point now = Clock::now();
    const bool done = o.duration_s > 0 && std::chrono::duration<double>(now - begin).count() >= o.duration_s;
    if (now < next && !done) continue;
    next = now + every;
    const RunStatus status = watch->status();
    if (AllLeft(status)) {
      std::cerr << "aureole: no region server is left\n";
      return kExitFailed;
    }
    if (o.json) {
      std::cout << StatusJson(status).dump() << std::endl;
    } else if (terminal) {
      screen.Draw(TableLines(heading, status));
      std::fflush(stdout);
    } else {
      std::cout << PlainLine(heading, status) << std::endl;
    }
    if (done) return kExitOk;
  }
  return o.duration_s > 0 ? kExitInterrupted : kExitOk;
}

}  // namespace aureole
