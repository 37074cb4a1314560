#include "client/cli/live_table.h"

#include <sys/ioctl.h>

#include <algorithm>
#include <utility>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/strings/str_join.h>

namespace aureole {
namespace {

constexpr size_t kDefaultWidth = 160;

double Seconds(const Heading& heading, Tick tick) {
  return static_cast<double>(tick) * static_cast<double>(heading.tick_us) * 1e-6;
}

struct Total {
  v1::FrameTime frame;  // of the slowest region in each figure
  size_t slowest = 0;
  double real_time_factor = 0;  // of the slowest member
  double bytes_per_second = 0;
  int64_t auras = 0, transfers = 0, waits = 0, wait_us = 0, violations = 0;
};

Total Sum(const RunStatus& status) {
  Total t;
  bool any = false;
  for (size_t i = 0; i < status.regions.size(); ++i) {
    const RegionStatus& r = status.regions[i];
    if (r.frame.max_ms() > t.frame.max_ms()) t.slowest = i;
    t.frame.set_mean_ms(std::max(t.frame.mean_ms(), r.frame.mean_ms()));
    t.frame.set_p99_ms(std::max(t.frame.p99_ms(), r.frame.p99_ms()));
    t.frame.set_max_ms(std::max(t.frame.max_ms(), r.frame.max_ms()));
    const double factor = r.report.real_time_factor();
    if (r.member) t.real_time_factor = std::exchange(any, true) ? std::min(t.real_time_factor, factor) : factor;
    t.bytes_per_second += r.bytes_per_second;
    t.auras += r.report.auras_told();
    t.transfers += r.report.transfers();
    t.waits += r.report.waits();
    t.wait_us += r.report.wait_us();
    t.violations += r.report.violations();
  }
  return t;
}

// Its server has ended, and no region is there.
bool IsGone(const RegionStatus& r) { return r.left && !r.member; }

const char* Name(Stage stage) {
  switch (stage) {
    case Stage::kJoining:
      return "starting";
    case Stage::kLoading:
    case Stage::kReady:
      return "loading";
    case Stage::kRunning:
      return "running";
    case Stage::kFinished:
      return "finished";
  }
  return "";
}

std::string TableRow(const std::string& name, Tick tick, double factor, int64_t bodies, int64_t awake,
                     const v1::FrameTime& frame, int64_t auras, int64_t transfers, double bytes_per_second,
                     int64_t waits, int64_t wait_us, int64_t violations) {
  return absl::StrFormat("%-7s %9d %6.2f %7d %7d %7d %8.2f %8.2f %8.2f %7d %9d %9s/s %7d %8.1f %10d", name, tick,
                         factor, bodies, awake, bodies - awake, frame.mean_ms(), frame.p99_ms(), frame.max_ms(), auras,
                         transfers, HumanBytes(bytes_per_second), waits, static_cast<double>(wait_us) * 1e-6,
                         violations);
}

}  // namespace

std::string HumanBytes(double bytes) {
  constexpr const char* kUnits[] = {"B", "kB", "MB", "GB", "TB"};
  size_t unit = 0;
  while (bytes >= 1000 && unit + 1 < std::size(kUnits)) {
    bytes /= 1000;
    ++unit;
  }
  return absl::StrFormat(unit == 0 || bytes >= 100 ? "%.0f %s" : "%.1f %s", bytes, kUnits[unit]);
}

std::vector<std::string> TableLines(const Heading& heading, const RunStatus& status) {
  const Total total = Sum(status);
  const Tick tick = status.MinTick();
  const auto regions =
      std::count_if(status.regions.begin(), status.regions.end(), [](const RegionStatus& r) { return !IsGone(r); });
  std::string first = absl::StrFormat("%s: %s, %d region%s, %.1f s simulated", heading.world, Name(status.stage),
                                      regions, regions == 1 ? "" : "s", Seconds(heading, tick));
  if (heading.last_tick > 0) absl::StrAppendFormat(&first, " of %.1f", Seconds(heading, heading.last_tick));
  absl::StrAppendFormat(&first, ", %.2f of real time", total.real_time_factor);
  std::vector<std::string> lines = {first, ""};
  lines.push_back(absl::StrFormat("%-7s %9s %6s %7s %7s %7s %8s %8s %8s %7s %9s %11s %7s %8s %10s", "region", "tick",
                                  "speed", "bodies", "awake", "asleep", "mean ms", "p99 ms", "max ms", "auras",
                                  "transfers", "sent", "waits", "wait s", "violations"));
  for (size_t i = 0; i < status.regions.size(); ++i) {
    const RegionStatus& r = status.regions[i];
    if (IsGone(r)) continue;
    lines.push_back(TableRow(absl::StrCat(i), r.report.tick(), r.report.real_time_factor(), r.report.bodies(),
                             r.report.awake(), r.frame, r.report.auras_told(), r.report.transfers(), r.bytes_per_second,
                             r.report.waits(), r.report.wait_us(), r.report.violations()));
  }
  lines.push_back(TableRow("all", tick, total.real_time_factor, status.Bodies(), status.Awake(), total.frame,
                           total.auras, total.transfers, total.bytes_per_second, total.waits, total.wait_us,
                           total.violations));
  const std::vector<std::string> waiting = status.Waiting();
  lines.push_back(waiting.empty() ? "" : absl::StrCat("waiting: ", absl::StrJoin(waiting, "; ")));
  lines.push_back(ServersLine(status));
  return lines;
}

std::string ServersLine(const RunStatus& status) {
  std::vector<std::string> endpoints;
  for (const RegionStatus& r : status.regions) {
    if (!IsGone(r)) endpoints.push_back(r.endpoint);
  }
  return absl::StrCat("servers: ", absl::StrJoin(endpoints, " "));
}

std::string PlainLine(const Heading& heading, const RunStatus& status) {
  const Total t = Sum(status);
  const Tick tick = status.MinTick();
  std::string line;
  if (status.stage < Stage::kRunning) {
    line = Name(status.stage);
  } else {
    line = absl::StrFormat(
        "tick %d (%.1f s), speed %.2f, bodies %d (%d awake), frame ms mean %.2f p99 %.2f max %.2f (region %d), auras "
        "%d, transfers %d, sent %s/s, waits %d (%.1f s), violations %d",
        tick, Seconds(heading, tick), t.real_time_factor, status.Bodies(), status.Awake(), t.frame.mean_ms(),
        t.frame.p99_ms(), t.frame.max_ms(), t.slowest, t.auras, t.transfers, HumanBytes(t.bytes_per_second), t.waits,
        static_cast<double>(t.wait_us) * 1e-6, t.violations);
  }
  const std::vector<std::string> waiting = status.Waiting();
  if (!waiting.empty()) absl::StrAppend(&line, "; ", absl::StrJoin(waiting, "; "));
  return line;
}

void Screen::Draw(const std::vector<std::string>& lines) {
  winsize size = {};
  const bool known = ioctl(fileno(terminal_), TIOCGWINSZ, &size) == 0 && size.ws_col > 0;
  const size_t width = known ? size.ws_col : kDefaultWidth;
  std::string out = drawn_ > 0 ? absl::StrFormat("\x1b[%dA", drawn_) : "";
  for (const std::string& line : lines) absl::StrAppend(&out, "\r", line.substr(0, width), "\x1b[K\n");
  absl::StrAppend(&out, "\x1b[J");
  drawn_ = lines.size();
  std::fwrite(out.data(), 1, out.size(), terminal_);
  std::fflush(terminal_);
}

}  // namespace aureole
