#include "client/cli/measured_runs.h"

#include <unistd.h>

#include <chrono>
#include <iostream>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>

#include "client/cli/exit_codes.h"
#include "server/control/interrupts.h"
#include "server/control/local_allocator.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;

// Where a run is, on stderr: one line in place on a terminal, else a line every five seconds.
class Progress {
 public:
  Progress(std::string name, Tick last_tick, int64_t tick_us)
      : name_(std::move(name)), last_tick_(last_tick), tick_s_(static_cast<double>(tick_us) * 1e-6) {}
  ~Progress() {
    if (terminal_ && shown_) std::cerr << "\r\x1b[K" << std::flush;
  }

  void Show(const RunStatus& status) {
    const auto now = Clock::now();
    if (now < next_) return;
    next_ = now + (terminal_ ? std::chrono::milliseconds(500) : std::chrono::milliseconds(5000));
    shown_ = true;
    const Tick tick = status.MinTick();
    std::string line = absl::StrFormat("%s: %.1f of %.1f s, %d bodies", name_, static_cast<double>(tick) * tick_s_,
                                       static_cast<double>(last_tick_) * tick_s_, status.Bodies());
    for (const std::string& w : status.Waiting()) absl::StrAppend(&line, "; ", w);
    if (terminal_) {
      std::cerr << "\r" << line.substr(0, 150) << "\x1b[K" << std::flush;
    } else {
      std::cerr << line << '\n';
    }
  }

 private:
  const std::string name_;
  const Tick last_tick_;
  const double tick_s_;
  const bool terminal_ = isatty(STDERR_FILENO) != 0;
  bool shown_ = false;
  Clock::time_point next_{};
};

}  // namespace

absl::StatusOr<RunMeasure> MeasuredRun(const std::string& name, const RunOptions& run, int64_t tick_us,
                                       const std::string& region_server) {
  LocalAllocator allocator({region_server, "", false});
  RunResult result;
  Progress progress(name, run.last_tick, tick_us);
  const absl::Status s = RunWorld(
      run, allocator,
      [&progress](const RunStatus& status) {
        progress.Show(status);
        return Interrupts() == 0;
      },
      &result);
  if (!s.ok()) return absl::Status(s.code(), absl::StrCat(name, ": ", s.message()));
  return Measure(result, tick_us);
}

absl::StatusOr<std::vector<RunMeasure>> MeasuredRuns(const std::string& name, const RunOptions& run, int64_t tick_us,
                                                     int repeat, const std::string& region_server) {
  std::vector<RunMeasure> out;
  for (int i = 0; i < repeat; ++i) {
    const std::string label = repeat > 1 ? absl::StrFormat("%s, %d of %d", name, i + 1, repeat) : name;
    absl::StatusOr<RunMeasure> measured = MeasuredRun(label, run, tick_us, region_server);
    if (!measured.ok()) return measured.status();
    out.push_back(*std::move(measured));
  }
  return out;
}

int ExitCode(const absl::Status& runs, const absl::Status& written, bool exact) {
  if (absl::IsCancelled(runs)) {
    std::cerr << "aureole: interrupted\n";
    return kExitInterrupted;
  }
  for (const absl::Status& s : {runs, written}) {
    if (s.ok()) continue;
    std::cerr << "aureole: " << s.message() << '\n';
    return kExitFailed;
  }
  if (!exact) std::cerr << "aureole: not every split run was exact\n";
  return exact ? kExitOk : kExitFailed;
}

}  // namespace aureole
