#include "tests/bench/stopped_clients.h"

#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <thread>

#include <nlohmann/json.hpp>

#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "tests/bench/load_process.h"
#include "tests/bench/rolling.h"

namespace aureole {
namespace {

using Json = nlohmann::json;

constexpr char kMeasured[] = "12s";  // longer than a server waits for a reader

double ResidentMb(int64_t pid) {
  std::ifstream in("/proc/" + std::to_string(pid) + "/status");
  std::string line;
  long long kb = 0;
  while (std::getline(in, line) && std::sscanf(line.c_str(), "VmRSS: %lld kB", &kb) != 1) {
  }
  return static_cast<double>(kb) / 1024;
}

// Runs clients for a while; the largest resident memory of the server meanwhile.
Json RunLoad(const std::string& program, const RegionStatus& server, int clients, double* memory_mb) {
  const std::filesystem::path file =
      std::filesystem::temp_directory_path() / ("stopped-clients-" + std::to_string(getpid()) + ".json");
  LoadProcess load(program, server.endpoint, clients, kMeasured, file.string());
  std::atomic<bool> done = false;
  std::thread sampler([&] {
    while (!done) {
      *memory_mb = std::max(*memory_mb, ResidentMb(server.pid));
      std::this_thread::sleep_for(std::chrono::milliseconds(100));
    }
  });
  load.Wait();
  done = true;
  sampler.join();
  std::ifstream in(file);
  const Json out = Json::parse(in, nullptr, false);
  std::filesystem::remove(file);
  return out;
}

}  // namespace

StoppedClientsResult MeasureStoppedClients(const StoppedClientsOptions& options) {
  const std::filesystem::path here = std::filesystem::read_symlink("/proc/self/exe").parent_path();
  const std::string program = options.aureole.empty() ? (here / "aureole").string() : options.aureole;
  RunOptions run;
  run.world = Rolling(options.bodies);
  LocalAllocator allocator({});
  RunResult result;
  StoppedClientsResult out;
  Json before, after;
  const absl::Status end = RunWorld(
      run, allocator,
      [&](const RunStatus& status) {
        if (status.stage != Stage::kRunning || status.MinTick() < 60) return true;
        const RegionStatus& server = status.regions[0];
        const int reading = options.clients - options.stopped;
        LoadProcess others(program, server.endpoint, options.stopped, "3600s");
        before = RunLoad(program, server, reading, &out.memory_before_mb);
        others.Signal(SIGSTOP);
        after = RunLoad(program, server, reading, &out.memory_after_mb);
        return false;
      },
      &result);
  out.ok = absl::IsCancelled(end) && before.is_object() && after.is_object();
  if (!out.ok) {
    std::fprintf(stderr, "stopped: %s\n", std::string(end.message()).c_str());
    return out;
  }
  out.rate_before = before["least_frames_per_second"];
  out.rate_after = after["least_frames_per_second"];
  out.p99_before_ms = before["interval_ms"]["p99"];
  out.p99_after_ms = after["interval_ms"]["p99"];
  return out;
}

}  // namespace aureole
