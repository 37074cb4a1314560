#include "server/control/scaling_run.h"

#include <utility>

#include <absl/strings/str_cat.h>

namespace aureole {
namespace {

// Servers report about every 200 ms; what is older says nothing of now.
constexpr std::chrono::milliseconds kSilence{1500};
constexpr double kAsleep = 0.05;  // of the weight of a body that is awake

}  // namespace

LoadSeen SeeLoad(const RunStatus& status, const LayoutDesk::State& layout, std::chrono::steady_clock::time_point now) {
  static const RegionStatus kNothing;
  LoadSeen out;
  out.time = now;
  out.steady = status.stage == Stage::kRunning && !layout.changing;
  out.tick = status.MinTick();
  for (size_t i = 0; i < layout.now.regions.size(); ++i) {
    if (!layout.now.regions[i].HasArea()) continue;
    const RegionStatus& r = i < status.regions.size() ? status.regions[i] : kNothing;
    const bool runs = r.ready && !r.left && !r.finished && !r.report.replaying();
    out.steady &=
        runs && r.frame.ticks() > 0 && r.report.layout_epoch() == layout.now.epoch && now - r.reported < kSilence;
    out.regions.push_back({r.frame.p99_ms(), r.report.awake()});
  }
  return out;
}

std::vector<double> WeightsOf(const RunStatus& status) {
  std::vector<double> out;
  for (const RegionStatus& r : status.regions) {
    const auto awake = static_cast<double>(r.report.awake()), bodies = static_cast<double>(r.report.bodies());
    out.push_back(awake + kAsleep * (bodies - awake));
  }
  return out;
}

ScalingRun::ScalingRun(const ScalingOptions& options, LayoutDesk* desk, std::function<void(const std::string&)> tell)
    : desk_(desk), tell_(std::move(tell)), autoscaler_(options, desk->world().environment.tick_us) {}

void ScalingRun::Step(const RunStatus& status) {
  const std::optional<Scaling> scaling =
      autoscaler_.Look(SeeLoad(status, desk_->state(), std::chrono::steady_clock::now()));
  if (!scaling.has_value()) return;
  const absl::Status s = desk_->ResizeTo(scaling->to, WeightsOf(status));
  tell_(s.ok() ? scaling->Text() : absl::StrCat("not ", scaling->Text(), ", because ", std::string(s.message())));
}

}  // namespace aureole
