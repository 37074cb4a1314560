#include "client/cli/doctor.h"

#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <thread>
#include <vector>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <grpcpp/grpcpp.h>
#include <nlohmann/json.hpp>

#include "client/cli/connect.h"
#include "client/cli/exit_codes.h"
#include "client/cli/layout_watch.h"
#include "client/src/channel.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;
using Json = nlohmann::ordered_json;

enum class Level { kFine, kWarning, kFailure };

struct Finding {
  Level level = Level::kFine;
  std::string what, remedy;
};

const char* Name(Level level) {
  switch (level) {
    case Level::kFine:
      return "ok";
    case Level::kWarning:
      return "warning";
    case Level::kFailure:
      return "FAILURE";
  }
  return "";
}

class Doctor {
 public:
  void Machine() {
    const unsigned cores = std::thread::hardware_concurrency();
    if (cores >= 2) {
      Say(Level::kFine, absl::StrCat(cores, " processors"));
    } else {
      Say(Level::kWarning, "1 processor", "region servers share it: run fewer regions, or a machine with more");
    }
    const std::filesystem::path server = OwnDirectory() / "aureole-region";
    if (access(server.c_str(), X_OK) == 0) {
      Say(Level::kFine, "aureole-region is beside aureole");
    } else {
      Say(Level::kFailure, absl::StrCat(server.string(), " cannot be run"), "build it: ./dev build");
    }
    rlimit files = {};
    getrlimit(RLIMIT_NOFILE, &files);
    if (files.rlim_cur >= 1024) {
      Say(Level::kFine, absl::StrCat(files.rlim_cur, " files may be open"));
    } else {
      Say(Level::kWarning, absl::StrCat("only ", files.rlim_cur, " files may be open"),
          "each client is one; raise it: ulimit -n 4096");
    }
    const int64_t free_mb = FreeMemoryMb();
    if (free_mb >= 512) {
      Say(Level::kFine, absl::StrCat(free_mb, " MB of memory are free"));
    } else {
      Say(Level::kWarning, absl::StrCat("only ", free_mb, " MB of memory are free"),
          "a body takes about 2 kB, a server 40 MB");
    }
    // How late a sleeper wakes up: what is left of a tick has to be larger.
    double worst = 0;
    for (int i = 0; i < 50; ++i) {
      const Clock::time_point due = Clock::now() + std::chrono::milliseconds(2);
      std::this_thread::sleep_until(due);
      worst = std::max(worst, std::chrono::duration<double, std::milli>(Clock::now() - due).count());
    }
    if (worst < 4) {
      Say(Level::kFine, absl::StrFormat("timers are at most %.2f ms late", worst));
    } else {
      Say(Level::kWarning, absl::StrFormat("timers are up to %.1f ms late", worst),
          "the machine is busy: worlds may run slower than real time");
    }
  }

  void World(const std::string& server) {
    std::string error;
    const std::unique_ptr<LayoutWatch> watch = LayoutWatch::Open(server, &error);
    if (watch == nullptr) {
      Say(Level::kFailure, absl::StrCat(server, " does not answer: ", error), "see aureole up for the servers");
      return;
    }
    const v1::GetWorldResponse world = watch->world();
    const size_t servers = client::EndpointsOf(world).size();
    Say(Level::kFine, absl::StrCat("world ", world.name(), " on ", servers, " region servers"));
    for (int r = 0; r < world.endpoints_size(); ++r) {
      if (!world.endpoints(r).empty()) Server(world, r);
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(1200));  // each tells about five times a second
    const RunStatus status = watch->status();
    const double tick_ms = static_cast<double>(world.tick_us()) * 1e-3;
    for (size_t r = 0; r < status.regions.size(); ++r) {
      const RegionStatus& region = status.regions[r];
      if (!region.member) continue;
      if (region.left || region.report.tick() == 0) {
        Say(Level::kFailure, absl::StrFormat("region %d does not tell its status %s", r, region.goodbye),
            "its tick stands still, or it is gone: see its log");
        continue;
      }
      const double factor = region.report.real_time_factor(), p99 = region.frame.p99_ms();
      if (factor < 0.95) {
        Say(Level::kWarning, absl::StrFormat("region %d runs at %.2f of real time", r, factor),
            p99 > tick_ms ? "its ticks take too long: more regions, or fewer bodies"
                          : "it waits for another: see aureole top");
      } else {
        Say(Level::kFine, absl::StrFormat("region %d: speed %.2f, %d bodies, p99 of a tick %.2f of %.1f ms", r, factor,
                                          region.report.bodies(), p99, tick_ms));
      }
      if (region.report.violations() > 0) {
        Say(Level::kFailure,
            absl::StrFormat("region %d: %d violations: bodies touched and were stepped apart", r,
                            region.report.violations()),
            "its answer is not that of one server: raise the world's tolerances, or use delay 0");
      }
    }
    for (const std::string& waiting : status.Waiting()) Say(Level::kWarning, waiting, "see the log of that server");
  }

  int Print(bool json) const {
    Json list = Json::array();
    for (const Finding& f : findings_) {
      if (json) {
        list.push_back({{"level", Name(f.level)}, {"what", f.what}, {"remedy", f.remedy}});
      } else {
        std::cout << absl::StrFormat("%-8s %s%s\n", Name(f.level), f.what, f.remedy.empty() ? "" : "; " + f.remedy);
      }
    }
    if (json) std::cout << list.dump() << '\n';
    const bool failed =
        std::any_of(findings_.begin(), findings_.end(), [](const Finding& f) { return f.level == Level::kFailure; });
    return failed ? kExitFailed : kExitOk;
  }

 private:
  void Say(Level level, std::string what, std::string remedy = "") {
    findings_.push_back({level, std::move(what), std::move(remedy)});
  }

  static std::filesystem::path OwnDirectory() {
    std::error_code error;
    return std::filesystem::read_symlink("/proc/self/exe", error).parent_path();
  }

  static int64_t FreeMemoryMb() {
    std::ifstream in("/proc/meminfo");
    std::string line;
    long long kb = 0;
    while (std::getline(in, line)) {
      if (std::sscanf(line.c_str(), "MemAvailable: %lld kB", &kb) == 1) break;
    }
    return kb / 1024;
  }

  // Whether clients reach it, how far it is, and whether it is of the same run.
  void Server(const v1::GetWorldResponse& world, int r) {
    const std::string& endpoint = world.endpoints(r);
    const auto stub = v1::Simulation::NewStub(client::ChannelTo(endpoint, GivenAccess()));
    double least_ms = 1e9;
    v1::GetWorldResponse answer;
    for (int i = 0; i < 5; ++i) {
      grpc::ClientContext context;
      context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(3));
      const Clock::time_point asked = Clock::now();
      if (const grpc::Status s = stub->GetWorld(&context, {}, &answer); !s.ok()) {
        Say(Level::kFailure, absl::StrCat("region ", r, ", ", endpoint, ", does not answer: ", s.error_message()),
            "the run cannot go on without it: see its log");
        return;
      }
      least_ms = std::min(least_ms, std::chrono::duration<double, std::milli>(Clock::now() - asked).count());
    }
    if (answer.name() != world.name() || answer.region() != r || answer.layout_epoch() < world.layout_epoch()) {
      Say(Level::kFailure,
          absl::StrCat("region ", r, ", ", endpoint, ", serves region ", answer.region(), " of world ", answer.name(),
                       ", layout epoch ", answer.layout_epoch()),
          "another run has taken its address; connect to a server of the right one");
      return;
    }
    Say(least_ms < 20 ? Level::kFine : Level::kWarning,
        absl::StrFormat("region %d, %s, answers in %.2f ms", r, endpoint, least_ms),
        least_ms < 20 ? "" : "it is far away: pushes and pictures are as late");
  }

  std::vector<Finding> findings_;
};

}  // namespace

CLI::App* AddDoctor(CLI::App& app, DoctorOptions* o) {
  CLI::App* c = app.add_subcommand("doctor", "Check this machine, and a running world");
  c->add_option("--server", o->server, "Any region server of a world; without it only the machine is checked")
      ->type_name("HOST:PORT");
  AddAccess(c);
  c->add_flag("--json", o->json, "JSON");
  c->footer(
      std::string("Examples:\n"
                  "  aureole doctor\n"
                  "  aureole doctor --server 127.0.0.1:40001\n\n"
                  "Exit codes: 0 nothing failed; 1 something did; 2 bad input."));
  return c;
}

int RunDoctor(const DoctorOptions& o) {
  Doctor doctor;
  doctor.Machine();
  if (!o.server.empty()) doctor.World(o.server);
  return doctor.Print(o.json);
}

}  // namespace aureole
