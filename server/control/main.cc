// aureole-control: the control plane as a process of its own, with region servers as local processes. It logs plain
// lines; `aureole up` is the same with a table.
#include <CLI/CLI.hpp>
#include <filesystem>
#include <iostream>
#include <memory>
#include <optional>
#include <string>

#include <absl/strings/str_format.h>
#include <absl/time/time.h>

#include "server/control/interrupts.h"
#include "server/control/kubernetes/control_process.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/scaling_flags.h"
#include "server/control/sqlite_store.h"
#include "server/control/world_file.h"
#include "server/transport/health_check.h"

namespace {

constexpr int kOk = 0, kFailed = 1, kBadInput = 2;

}  // namespace

int main(int argc, char** argv) {
  if (argc > 1 && argv[1] == std::string("kubernetes")) return aureole::kubernetes::KubernetesMain(argc - 1, argv + 1);
  aureole::CatchInterrupts();
  CLI::App app{
      "Runs one world on region servers that it starts on this machine. `aureole-control kubernetes` runs all Worlds "
      "of "
      "a namespace."};
  app.footer(
      "Example:\n  aureole-control tests/worlds/demo.json --listen 127.0.0.1:7000\n\n"
      "Exit codes: 0 it ran, 1 the run failed, 2 bad input (then nothing was started).");
  std::string world_path, duration, store_path, health_check;
  double checkpoint_s = 1;
  aureole::RunOptions options;
  aureole::LocalAllocator::Options servers;
  app.add_option("world", world_path, "World file (JSON)");
  app.add_option("--listen", options.listen, "Where region servers join, host:port; port 0 is any")
      ->capture_default_str();
  app.add_option("--duration", duration, "Simulated time, such as 60s or 2m; until interrupted when not given");
  app.add_option("--hash-every", options.hash_every, "Ticks between state hashes; 0 for none")
      ->check(CLI::NonNegativeNumber);
  app.add_flag("--no-real-time", options.no_real_time, "As fast as it can");
  aureole::AddScalingFlags(&app, &options.scaling);
  app.add_option("--region-server", servers.executable, "Program to start; beside this one when not given");
  app.add_option("--logs", servers.log_directory, "Directory for the servers' logs; kept");
  app.add_option("--data", servers.data_directory, "Directory for checkpoints; beside the logs when not given");
  app.add_option("--checkpoint-every", checkpoint_s, "Seconds of simulated time between checkpoints; 0 for none")
      ->check(CLI::Range(0.0, 3600.0))
      ->capture_default_str();
  app.add_option("--store", store_path,
                 "File of what is known of the world. With it the region servers go on when this process ends by "
                 "anything but Ctrl-C, and the next one with the same store joins them; logs and checkpoints are "
                 "beside it when not given");
  app.add_option("--tls", options.security.tls,
                 "Directory with ca.crt, tls.crt and tls.key, for this and the servers; plain text when not given");
  app.add_option("--tokens", options.security.tokens, "File of the tokens that clients need; none when not given");
  app.add_flag("--insecure", options.security.insecure,
               "Allow plain text, and clients without tokens, beyond this machine");
  app.add_option("--health-check", health_check, "Only ask the control plane at host:port whether it is serving");
  try {
    app.parse(argc, argv);
    if (world_path.empty() && health_check.empty()) throw CLI::RequiredError("world");
  } catch (const CLI::ParseError& e) {
    return app.exit(e) == 0 ? kOk : kBadInput;
  }
  if (!health_check.empty()) {
    const auto security = aureole::Security::Open(options.security);
    const absl::Status s =
        security.ok() ? aureole::CheckHealth(health_check, (*security)->channel()) : security.status();
    std::cerr << (s.ok() ? "serving" : std::string(s.message())) << '\n';
    return s.ok() ? kOk : kFailed;
  }
  const absl::StatusOr<aureole::WorldFile> file = aureole::OpenWorldFile(world_path);
  if (!file.ok()) {
    std::cerr << file.status().message() << '\n';
    return kBadInput;
  }
  absl::Duration length;
  if (!duration.empty() && (!absl::ParseDuration(duration, &length) || length <= absl::ZeroDuration() ||
                            length == absl::InfiniteDuration())) {
    std::cerr << "--duration: '" << duration << "' is not a time such as 60s, 2m or 500ms\n";
    return kBadInput;
  }
  if (absl::Status s = aureole::CheckScalingFlags(options.scaling, file->world); !s.ok()) {
    std::cerr << s.message() << '\n';
    return kBadInput;
  }
  options.world = file->spec;
  aureole::LayoutDesk layouts(file->world);
  options.layouts = &layouts;
  options.regions = file->world.layout.size();
  const int64_t tick_us = file->world.environment.tick_us;
  if (!duration.empty()) options.last_tick = aureole::TicksIn(absl::ToDoubleSeconds(length), tick_us);

  if (checkpoint_s > 0) options.checkpoint_every = aureole::TicksIn(checkpoint_s, tick_us);

  std::unique_ptr<aureole::SqliteStore> store;
  std::vector<aureole::RunEvent> before;
  if (!store_path.empty()) {
    if (options.checkpoint_every == 0) {
      std::cerr << "--store: servers that go on by themselves need checkpoints; leave --checkpoint-every as it is\n";
      return kBadInput;
    }
    absl::StatusOr<std::unique_ptr<aureole::SqliteStore>> opened = aureole::SqliteStore::Open(store_path);
    if (!opened.ok()) {
      std::cerr << "--store: " << opened.status().message() << '\n';
      return kFailed;
    }
    store = *std::move(opened);
    absl::StatusOr<std::vector<aureole::RunEvent>> kept = store->Events(aureole::EventLog::kMostEvents);
    if (!kept.ok()) {
      std::cerr << "--store: " << kept.status().message() << '\n';
      return kFailed;
    }
    before = *std::move(kept);
    const std::filesystem::path beside = std::filesystem::absolute(store_path).parent_path();
    if (servers.log_directory.empty()) servers.log_directory = beside / "logs";
    if (servers.data_directory.empty()) servers.data_directory = beside / "data";
    servers.outlive = true;
    options.store = store.get();
    options.control_epoch = store->epoch();
    options.leave = &aureole::Terminated();
  }
  aureole::EventLog events(std::move(before));
  options.events = &events;
  servers.verbose = true;
  servers.flags = aureole::FlagsOf(options.security);
  options.security.log = [](const std::string& what) { std::cerr << "[control] " << what << '\n'; };
  aureole::LocalAllocator allocator(servers);
  aureole::RunResult result;
  aureole::Stage stage = aureole::Stage::kFinished;
  const absl::Status status = aureole::RunWorld(
      options, allocator,
      [&](const aureole::RunStatus& now) {
        if (now.stage != stage) {
          constexpr const char* kNames[] = {"starting", "loading", "ready", "running", "finished"};
          std::cerr << "[control] " << kNames[static_cast<int>(now.stage)] << ", " << now.regions.size()
                    << " regions\n";
          stage = now.stage;
        }
        return aureole::Interrupts() == 0 || (options.leave != nullptr && aureole::Terminated());
      },
      &result,
      [&store](const aureole::RunEvent& event) {
        std::cerr << "[control] " << aureole::TextOf(event) << '\n';
        if (store == nullptr) return;
        if (absl::Status s = store->Append(event); !s.ok()) std::cerr << "[control] " << s.message() << '\n';
      });
  if (aureole::Terminated() && store != nullptr && absl::IsCancelled(status)) {
    std::cerr << "[control] left; " << result.status.regions.size() << " servers go on; start it again with --store "
              << store_path << '\n';
    return kOk;
  }
  if (!status.ok() && !absl::IsCancelled(status)) {
    std::cerr << "[control] " << status.message() << '\n';
    return kFailed;
  }
  std::cerr << absl::StrFormat("[control] %d ticks, %d bodies\n", result.status.MinTick(), result.status.Bodies());
  return kOk;
}
