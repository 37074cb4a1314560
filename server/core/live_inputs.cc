#include "server/core/live_inputs.h"

#include <algorithm>

#include <absl/strings/str_cat.h>

#include "server/core/check.h"

namespace aureole {

absl::Status CheckLiveInput(const Input& input) {
  if (input.source == 0) return absl::InvalidArgumentError("input.source: must not be 0");
  if (input.sequence == 0) return absl::InvalidArgumentError("input.sequence: must be at least 1");
  if (input.body == 0) return absl::InvalidArgumentError("input.body: must not be 0");
  if (input.kind != Input::Kind::kImpulse && input.kind != Input::Kind::kVelocity &&
      input.kind != Input::Kind::kRemove) {
    return absl::InvalidArgumentError("input.kind: must be an impulse, a velocity or a removal");
  }
  if (!input.linear.allFinite()) return absl::InvalidArgumentError("input.linear: must be finite");
  if (!input.angular.allFinite()) return absl::InvalidArgumentError("input.angular: must be finite");
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

void LiveInputs::Deliver(const std::vector<Input>& inputs, Tick effect, bool mine) {
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
    due_[effect].push_back(input);
    open_[{effect, name}] = {false, mine ? 1 : 0};
    effect_[name] = effect;
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
  outcomes_.push_back(it != source.recent.end() ? *it : InputOutcome{name, 0, false});
}

void LiveInputs::AppendDue(Tick n, std::vector<Input>* out) const {
  if (auto it = due_.find(n); it != due_.end()) out->insert(out->end(), it->second.begin(), it->second.end());
}

void LiveInputs::Heard(const std::vector<InputName>& applied) {
  for (const InputName& name : applied) {
    const auto it = effect_.find(name);
    AUREOLE_CHECK(it != effect_.end(), "input %llu of source %llu was applied, but not delivered",
                  static_cast<unsigned long long>(name.second), static_cast<unsigned long long>(name.first));
    Open& open = open_.at({it->second, name});
    AUREOLE_CHECK(!open.applied, "input %llu of source %llu was applied twice",
                  static_cast<unsigned long long>(name.second), static_cast<unsigned long long>(name.first));
    open.applied = true;
  }
}

void LiveInputs::Settle(Tick n) {
  while (!open_.empty() && open_.begin()->first.first <= n) {
    const auto& [key, open] = *open_.begin();
    const InputOutcome outcome{key.second, key.first, open.applied};
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
