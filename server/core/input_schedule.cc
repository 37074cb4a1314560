#include "server/core/input_schedule.h"

#include <algorithm>

namespace aureole {

void InputSchedule::Add(const Input& input) {
  due_[input.tick].push_back(input);
  if (input.ticks > 1) lasting_.push_back(input);
}

void InputSchedule::AppendDue(Tick n, std::vector<Input>* out) const {
  if (auto it = due_.find(n); it != due_.end()) out->insert(out->end(), it->second.begin(), it->second.end());
  for (const Input& input : lasting_) {
    if (n <= input.tick || n >= input.tick + input.ticks) continue;
    Input& again = out->emplace_back(input);
    again.tick = n;
    again.again = true;
  }
}

void InputSchedule::AppendAfter(Tick n, std::vector<Input>* out) const {
  for (auto it = due_.upper_bound(n); it != due_.end(); ++it)
    out->insert(out->end(), it->second.begin(), it->second.end());
  for (const Input& input : lasting_) {
    if (input.tick <= n && input.tick + input.ticks - 1 > n) out->push_back(input);
  }
}

const Input* InputSchedule::FindSpawn(Tick n, BodyId body) const {
  const auto due = due_.find(n);
  if (due == due_.end()) return nullptr;
  const auto it = std::find_if(due->second.begin(), due->second.end(),
                               [body](const Input& i) { return i.kind == Input::Kind::kSpawn && i.body == body; });
  return it == due->second.end() ? nullptr : &*it;
}

void InputSchedule::ForgetBefore(Tick n) {
  due_.erase(due_.begin(), due_.lower_bound(n));
  std::erase_if(lasting_, [n](const Input& i) { return i.tick + i.ticks <= n; });
}

}  // namespace aureole
