#include "tests/bench/fan_out.h"

#include <fcntl.h>
#include <signal.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <vector>

#include "aureole/v1/world.pb.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"

namespace aureole {
namespace {

constexpr int64_t kTickUs = 16'667;       // 60 per second
constexpr int64_t kWindowUs = 5'000'000;  // of the reports

// Spheres that roll for ever, in lanes.
v1::WorldSpec Rolling(int bodies) {
  v1::WorldSpec spec;
  spec.set_name("rolling");
  spec.mutable_tick()->set_nanos(static_cast<int32_t>(kTickUs * 1000));
  v1::Material& smooth = (*spec.mutable_materials())["default"];
  smooth.set_friction(0.5);
  smooth.set_angular_damping(0);
  spec.mutable_sleeping()->set_linear(0);
  spec.mutable_sleeping()->set_angular(0);
  spec.add_statics()->mutable_shape()->mutable_plane()->mutable_normal()->set_y(1);
  for (int i = 0; i < bodies; ++i) {
    v1::Body* b = spec.add_bodies();
    b->mutable_shape()->mutable_sphere()->set_radius(0.5);
    b->set_mass(1);
    b->mutable_position()->set_x(i % 25 * 4 - 50);
    b->mutable_position()->set_y(0.5);
    b->mutable_position()->set_z(i / 25 * 2 - 40);
    b->mutable_velocity()->set_x(i / 25 % 2 == 0 ? 1.5 : -1.5);
  }
  return spec;
}

// `aureole load` while it lives.
class Load {
 public:
  Load(const std::string& program, const std::string& server, int clients) {
    const std::string n = std::to_string(clients);
    const char* arguments[] = {program.c_str(), "load",       "--server", server.c_str(), "--clients",
                               n.c_str(),       "--duration", "3600s",    nullptr};
    posix_spawn_file_actions_t files;
    posix_spawn_file_actions_init(&files);
    posix_spawn_file_actions_addopen(&files, 1, "/dev/null", O_WRONLY, 0);
    if (posix_spawn(&pid_, program.c_str(), &files, nullptr, const_cast<char**>(arguments), environ) != 0) pid_ = -1;
    posix_spawn_file_actions_destroy(&files);
  }
  ~Load() {
    if (pid_ <= 0) return;
    kill(pid_, SIGINT);
    waitpid(pid_, nullptr, 0);
  }

 private:
  pid_t pid_ = -1;
};

double Median(std::vector<double> v) {
  if (v.empty()) return 0;
  std::sort(v.begin(), v.end());
  const size_t half = v.size() / 2;
  return v.size() % 2 == 1 ? v[half] : (v[half - 1] + v[half]) / 2;
}

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
  std::unique_ptr<Load> load;
  const absl::Status end = RunWorld(
      run, allocator,
      [&](const RunStatus& status) {
        // Blocks of two windows; the first one of each is for coming and going, the second one counts.
        const int64_t window = status.MinTick() * kTickUs / kWindowUs;
        const bool wanted = status.stage == Stage::kRunning && window > 0 && (window - 1) / 2 % 2 == 1;
        if (wanted && load == nullptr)
          load = std::make_unique<Load>(program, status.regions[0].endpoint, options.clients);
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
