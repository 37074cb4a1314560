#include "server/core/live_inputs.h"

#include <cmath>
#include <memory>

#include <absl/strings/str_cat.h>

#include "server/core/check.h"

namespace aureole {
namespace {

size_t BytesOf(const Shape& shape) {
  size_t bytes = 128 + sizeof(Vec3) * shape.points.size();
  for (const ChildShape& child : shape.children) bytes += 128 + BytesOf(*child.shape);
  return bytes;
}

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

absl::Status CheckLayoutChange(const Input& input) {
  if (input.layout == nullptr) return absl::InvalidArgumentError("input.layout: must be given");
  const absl::Status s = LayoutOf(*input.layout).status();
  return s.ok() ? s : absl::InvalidArgumentError(absl::StrCat("input.layout.", std::string(s.message())));
}

}  // namespace

absl::Status CheckLiveInput(const Input& input) {
  if (input.source == 0) return absl::InvalidArgumentError("input.source: must not be 0");
  if (input.sequence == 0) return absl::InvalidArgumentError("input.sequence: must be at least 1");
  if (input.kind < Input::Kind::kSpawn || input.kind > Input::Kind::kLayout) {
    return absl::InvalidArgumentError("input.kind: no such kind");
  }
  if ((input.kind == Input::Kind::kLayout) != (input.source == kControlSource)) {
    return absl::InvalidArgumentError(
        "input.source: the control plane changes the layout, and nobody and nothing else");
  }
  if (input.kind == Input::Kind::kLayout) return CheckLayoutChange(input);
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

size_t BytesOf(const Input& input, const Input* before) {
  constexpr size_t kPlain = 192, kBody = 320, kRegion = 48;
  if (input.layout != nullptr) return kPlain + kRegion * input.layout->regions.size();
  if (input.spawn == nullptr) return kPlain;
  const bool same = before != nullptr && before->spawn != nullptr && before->spawn->shape == input.spawn->shape;
  return kBody + (same ? 0 : BytesOf(*input.spawn->shape));
}

absl::Status LiveInputs::Offer(const Input& input) {
  if (absl::Status s = CheckLiveInput(input); !s.ok()) return s;
  offered_.push_back(input);
  return absl::OkStatus();
}

std::vector<Input> LiveInputs::TakeOffered() {
  std::vector<Input> out;
  int cost = 0;
  size_t bytes = 0;
  while (!offered_.empty()) {
    const Input& next = offered_.front();
    cost += CostOf(next);
    bytes += BytesOf(next, out.empty() ? nullptr : &out.back());
    if (!out.empty() && (cost > kMostPerTick || bytes > kMostBytesPerTick)) break;
    out.push_back(next);
    offered_.pop_front();
  }
  return out;
}

void LiveInputs::Deliver(const std::vector<Input>& inputs, Tick effect, Tick spawn_effect, bool mine) {
  for (const Input& told : inputs) {
    const bool spawn = told.kind == Input::Kind::kSpawn;
    const InputName name{told.source, told.sequence};
    const Tick tick = spawn ? spawn_effect : effect;
    Source* source = Find(told.source, tick);
    if (source == nullptr) {
      if (mine) outcomes_.push_back({.name = name, .tick = tick, .full = true});
      continue;
    }
    if (told.sequence <= source->last) {
      if (mine) Repeated(name);
      continue;
    }
    source->last = told.sequence;
    if (told.kind == Input::Kind::kLayout) {
      ChangeLayout(told, effect, mine);
      continue;
    }
    Open& open = open_[{tick, name}];
    open.mine = mine ? 1 : 0;
    open.over_area = told.over_area();
    open.removes_live = told.kind == Input::Kind::kRemove && IsLiveId(told.body);
    open.full = spawn ? bodies_ >= limits_.bodies : !TakeLasting(told, tick);
    effect_[name] = tick;
    if (open.full) continue;
    Input input = told;
    input.tick = tick;
    if (spawn) {
      ++bodies_;
      auto body = std::make_shared<BodySpec>(*told.spawn);
      body->id = input.body = open.spawned = next_body_++;
      input.spawn = std::move(body);
    }
    due_.Add(input);
    delivered_.push_back(std::move(input));
  }
}

void LiveInputs::ChangeLayout(const Input& told, Tick effect, bool mine) {
  const Tick adopted = effect - 1 + kLayoutNotice;
  const absl::Status s = division_ == nullptr ? absl::FailedPreconditionError("the layout of this world is fixed")
                                              : division_->Deliver(*told.layout, adopted);
  const InputName name{told.source, told.sequence};
  const Tick tick = s.ok() ? adopted : effect;
  Open& open = open_[{tick, name}];
  open.mine = mine ? 1 : 0;
  open.refused = std::string(s.message());
  effect_[name] = tick;
}

void LiveInputs::Learn(Reader& a) {
  VisitCommon(a);
  for (auto& [key, open] : open_) open.mine = 0;
}

// Null when there are too many and all have spoken of late.
LiveInputs::Source* LiveInputs::Find(uint64_t id, Tick effect) {
  if (id == kControlSource) return &sources_[id];
  if (!sources_.contains(id) && by_silence_.size() >= limits_.clients) {
    const auto [heard, silent] = *by_silence_.begin();
    if (heard + kKeptTicks >= effect) return nullptr;
    sources_.erase(silent);
    by_silence_.erase(by_silence_.begin());
  }
  Source& source = sources_[id];
  by_silence_.erase({source.heard, id});
  source.heard = effect;
  by_silence_.emplace(effect, id);
  return &source;
}

// Forces act again in every tick, so there are only so many. False: there is no room for this one.
bool LiveInputs::TakeLasting(const Input& input, Tick effect) {
  if (input.ticks == 1) return true;
  while (!lasting_.empty() && lasting_.begin()->first < effect) {
    lasting_cost_ -= lasting_.begin()->second;
    lasting_.erase(lasting_.begin());
  }
  if (lasting_cost_ + CostOf(input) > limits_.lasting) return false;
  lasting_cost_ += CostOf(input);
  lasting_.emplace(effect + input.ticks - 1, CostOf(input));
  return true;
}

// A repeated input gets the outcome of the first; when that is no longer kept, it is told as not applied at tick 0.
void LiveInputs::Repeated(const InputName& name) {
  if (auto it = effect_.find(name); it != effect_.end()) {
    ++open_.at({it->second, name}).mine;
    return;
  }
  const auto it = outcome_of_.find(name);
  outcomes_.push_back(it != outcome_of_.end() ? it->second : InputOutcome{name});
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
    if (open.removes_live) bodies_ -= bodies;
  }
}

void LiveInputs::Settle(Tick n) {
  while (!open_.empty() && open_.begin()->first.first <= n) {
    const auto& [key, open] = *open_.begin();
    const InputOutcome outcome{key.second, key.first, open.bodies, open.spawned, open.full, open.refused};
    outcomes_.insert(outcomes_.end(), static_cast<size_t>(open.mine), outcome);
    Keep(outcome);
    effect_.erase(outcome.name);
    open_.erase(open_.begin());
  }
  while (!recent_.empty() && (recent_.front().tick + kKeptTicks < n || recent_.size() > limits_.outcomes)) {
    outcome_of_.erase(recent_.front().name);
    recent_.pop_front();
  }
}

// A client that was forgotten may use a sequence again.
void LiveInputs::Keep(const InputOutcome& outcome) {
  if (outcome_of_.insert_or_assign(outcome.name, outcome).second) recent_.push_back(outcome);
}

}  // namespace aureole
