#include "server/control/kubernetes/world_scaler.h"

#include <utility>

#include <absl/strings/str_cat.h>

#include "server/control/scaling_run.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;

constexpr milliseconds kWriteAgain{5000}, kWriteWithin{2000};

}  // namespace

WorldScaler::WorldScaler(ApiClient* client, LayoutDesk* desk, std::function<bool()> leads, Tell tell)
    : client_(client), desk_(desk), leads_(std::move(leads)), tell_(std::move(tell)) {}

void WorldScaler::Look(const WorldResource& world, const RunStatus& status) {
  if (!world.scaling.on()) {
    autoscaler_.reset();
    wanted_.reset();
    return;
  }
  // With other options all begins anew.
  if (!autoscaler_.has_value() || autoscaler_->options() != world.scaling) {
    autoscaler_.emplace(world.scaling, desk_->world().environment.tick_us);
  }
  const LayoutDesk::State layout = desk_->state();
  if (layout.changing) wanted_.reset();  // somebody else was faster
  if (std::optional<Scaling> scaling = autoscaler_->Look(SeeLoad(status, layout, Clock::now()))) {
    wanted_ = std::move(scaling);
  }
  // What a person has said, but not within the bounds.
  const bool beyond = world.replicas_given != 0 && world.replicas_given != world.replicas;
  if (beyond && corrected_ != world.generation && !wanted_.has_value()) {
    wanted_ = {world.replicas_given, world.replicas,
               absl::StrCat("there must be ", world.scaling.min_regions, " to ", world.scaling.max_regions)};
  }
  if (wanted_.has_value() && Clock::now() >= next_try_ && leads_()) Write(world, status);
}

void WorldScaler::Write(const WorldResource& world, const RunStatus& status) {
  Patch patch;
  patch.body = {{"spec", {{"replicas", wanted_->to}}}};
  CallOptions options;
  options.timeout = options.attempt_timeout = kWriteWithin;
  absl::Status s = client_->Patch(WorldsOf(world.space).Sub("scale"), world.name, patch, options).status();
  if (!s.ok()) {
    next_try_ = Clock::now() + kWriteAgain;
    if (told_ != s) tell_(true, "CannotScale", absl::StrCat("spec.replicas: cannot be written: ", s.message()));
    told_ = s;
    return;
  }
  told_ = absl::OkStatus();
  corrected_ = world.generation;
  s = desk_->ResizeTo(wanted_->to, WeightsOf(status));
  tell_(!s.ok(), s.ok() ? "Scaled" : "CannotScale", s.ok() ? wanted_->Text() : std::string(s.message()));
  wanted_.reset();
}

}  // namespace aureole::kubernetes
