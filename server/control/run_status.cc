#include "server/control/run_status.h"

#include <algorithm>
#include <limits>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/strings/str_join.h>

namespace aureole {
namespace {

// Servers report about every 200 ms; less than this is nothing to talk about.
constexpr std::chrono::milliseconds kSilence{1500};

}  // namespace

Tick RunStatus::MinTick() const {
  Tick least = std::numeric_limits<Tick>::max();
  for (const RegionStatus& r : regions) {
    if (r.member) least = std::min<Tick>(least, r.report.tick());
  }
  return least == std::numeric_limits<Tick>::max() ? 0 : least;
}

Tick RunStatus::MaxTick() const {
  Tick most = 0;
  for (const RegionStatus& r : regions) most = std::max<Tick>(most, r.report.tick());
  return most;
}

int64_t RunStatus::Bodies() const {
  int64_t sum = 0;
  for (const RegionStatus& r : regions) sum += r.report.bodies();
  return sum;
}

int64_t RunStatus::Awake() const {
  int64_t sum = 0;
  for (const RegionStatus& r : regions) sum += r.report.awake();
  return sum;
}

std::vector<std::string> RunStatus::Waiting() const {
  std::vector<std::string> out;
  const auto now = std::chrono::steady_clock::now();
  for (size_t i = 0; i < regions.size(); ++i) {
    const RegionStatus& r = regions[i];
    if (stage == Stage::kJoining && !r.joined) out.push_back(absl::StrCat("region ", i, " has not joined"));
    if (stage == Stage::kLoading && !r.ready) out.push_back(absl::StrCat("region ", i, " loads the world"));
    if (stage != Stage::kRunning || r.finished || !r.member) continue;
    if (r.report.waiting_for_size() > 0) {
      out.push_back(absl::StrCat("region ", i, " waits for region ", absl::StrJoin(r.report.waiting_for(), ", ")));
    }
    if (now - r.reported > kSilence) {
      const double seconds = std::chrono::duration<double>(now - r.reported).count();
      out.push_back(absl::StrFormat("nothing heard of region %d for %.1f s", i, seconds));
    }
  }
  return out;
}

v1::FrameTime Merge(const std::deque<v1::FrameTime>& parts) {
  v1::FrameTime out;
  double total = 0;
  for (const v1::FrameTime& part : parts) {
    out.set_ticks(out.ticks() + part.ticks());
    total += part.mean_ms() * static_cast<double>(part.ticks());
    out.set_p99_ms(std::max(out.p99_ms(), part.p99_ms()));
    out.set_max_ms(std::max(out.max_ms(), part.max_ms()));
  }
  if (out.ticks() > 0) out.set_mean_ms(total / static_cast<double>(out.ticks()));
  return out;
}

}  // namespace aureole
