#include "server/core/live_inputs.h"

#include <algorithm>
#include <cmath>
#include <memory>

#include <absl/strings/str_cat.h>

#include "server/core/check.h"

namespace aureole {
namespace {

absl::Status CheckArea(const Input& input) {
  const Area& a = input.area;
  if (!(a.radius >= 0) || !std::isfinite(a.radius)) {
    return absl::InvalidArgumentError("input.area.radius: must be finite and not negative");
  }
  if (!a.centre.allFinite() || !std::isfinite(a.outward)) {
    return absl::InvalidArgumentError("input.area: must be finite");
  }
  if (input.over_area() && input.kind != Input::Kind::kImpulse && input.kind != Input::Kind::kVelocityChange) {
    return absl::InvalidArgumentError("input.area: only for impulses and changes of velocity");
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status CheckLiveInput(const Input& input) {
  if (input.source == 0) return absl::InvalidArgumentError("input.source: must not be 0");
  if (input.sequence == 0) return absl::InvalidArgumentError("input.sequence: must be at least 1");
  if (input.kind < Input::Kind::kSpawn || input.kind > Input::Kind::kVelocityChange) {
    return absl::InvalidArgumentError("input.kind: no such kind");
  }
  if (input.kind == Input::Kind::kSpawn) {
    if (input.spawn != nullptr && input.spawn->shape != nullptr) return absl::OkStatus();
    return absl::InvalidArgumentError("input.spawn: must be given, with a shape");
  }
  if (input.over_area() == (input.body != 0)) {
    return absl::InvalidArgumentError("input.body: must not be 0, or an area be given instead");
  }
  if (absl::Status s = CheckArea(input); !s.ok()) return s;
  if (!input.linear.allFinite()) return absl::InvalidArgumentError("input.linear: must be finite");
  if (!input.angular.allFinite()) return absl::InvalidArgumentError("input.angular: must be finite");
  if (!input.point.allFinite()) return absl::InvalidArgumentError("input.point: must be finite");
  if (input.frame > Input::Frame::kBody) return absl::InvalidArgumentError("input.frame: no such frame");
  const bool impulse = input.kind == Input::Kind::kImpulse;
  if (input.ticks < 1 || input.ticks > (impulse ? kMostInputTicks : 1)) {
    return absl::InvalidArgumentError("input.ticks: must be 1, or of an impulse at most 100000");
  }
  return absl::OkStatus();
}

absl::Status LiveInputs::Offer(const Input& input) {
  if (absl::Status s = CheckLiveInput(input); !s.ok()) return s;
  offered_.push_back(input);
  return absl::OkStatus();
}

std::vector<Input> LiveInputs::TakeOffered() {
  const auto end = offered_.begin() + static_cast<std::ptrdiff_t>(std::min(offered_.size(), kMostPerTick));
  std::vector<Input> out(offered_.begin(), end);
  offered_.erase(offered_.begin(), end);
  return out;
}

void LiveInputs::Deliver(const std::vector<Input>& inputs, Tick effect, Tick spawn_effect, bool mine) {
  for (const Input& told : inputs) {
    Source& source = sources_[told.source];
    const InputName name{told.source, told.sequence};
    if (told.sequence <= source.last) {
      if (mine) Repeated(source, name);
      continue;
    }
    source.last = told.sequence;
    Input input = told;
    input.tick = effect;
    if (input.kind == Input::Kind::kSpawn) {
      auto body = std::make_shared<BodySpec>(*told.spawn);
      body->id = input.body = next_body_++;
      input.spawn = std::move(body);
      input.tick = spawn_effect;
    }
    due_.Add(input);
    open_[{input.tick, name}] = {0, input.over_area(), input.spawn != nullptr ? input.body : 0, mine ? 1 : 0};
    effect_[name] = input.tick;
    delivered_.push_back(std::move(input));
  }
}

// A repeated input gets the outcome of the first; when that is no longer kept, it is told as not applied at tick 0.
void LiveInputs::Repeated(const Source& source, const InputName& name) {
  if (auto it = effect_.find(name); it != effect_.end()) {
    ++open_.at({it->second, name}).mine;
    return;
  }
  const auto it = std::find_if(source.recent.begin(), source.recent.end(),
                               [&name](const InputOutcome& o) { return o.name == name; });
  outcomes_.push_back(it != source.recent.end() ? *it : InputOutcome{name});
}

void LiveInputs::Applied(const Input& input, int64_t bodies) {
  if (bodies > 0 && !input.again) applied_.push_back({{input.source, input.sequence}, bodies});
}

void LiveInputs::Heard(const std::vector<AppliedInput>& applied) {
  for (const auto& [name, bodies] : applied) {
    const auto it = effect_.find(name);
    AUREOLE_CHECK(it != effect_.end(), "input %llu of source %llu was applied, but not delivered",
                  static_cast<unsigned long long>(name.second), static_cast<unsigned long long>(name.first));
    Open& open = open_.at({it->second, name});
    AUREOLE_CHECK(open.bodies == 0 || open.over_area, "input %llu of source %llu was applied twice",
                  static_cast<unsigned long long>(name.second), static_cast<unsigned long long>(name.first));
    open.bodies += bodies;
  }
}

void LiveInputs::Settle(Tick n) {
  while (!open_.empty() && open_.begin()->first.first <= n) {
    const auto& [key, open] = *open_.begin();
    const InputOutcome outcome{key.second, key.first, open.bodies, open.spawned};
    outcomes_.insert(outcomes_.end(), static_cast<size_t>(open.mine), outcome);
    Source& source = sources_.at(outcome.name.first);
    source.recent.push_back(outcome);
    if (source.recent.size() > kKeptOutcomes) source.recent.pop_front();
    effect_.erase(outcome.name);
    open_.erase(open_.begin());
  }
  if (n % kKeptTicks == 0) ForgetOutcomes(n);
}

void LiveInputs::ForgetOutcomes(Tick n) {
  for (auto& [id, source] : sources_) {
    if (!source.recent.empty() && source.recent.back().tick + kKeptTicks < n) source.recent = {};
  }
}

}  // namespace aureole
