#include "server/core/undivided.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "server/core/apply_input.h"

namespace aureole {

Undivided::Undivided(const World& world, std::unique_ptr<Engine> engine, Tick n)
    : world_(&world), engine_(std::move(engine)), tick_(n) {}

Undivided::Undivided(const World& world, std::unique_ptr<Engine> engine) : Undivided(world, std::move(engine), 0) {
  for (const BodySpec& b : world.bodies) engine_->Spawn(b);
  for (const JointSpec& j : world.joints) engine_->Join(j);
}

absl::StatusOr<Undivided> Undivided::Resume(const World& world, std::unique_ptr<Engine> engine, Tick n,
                                            std::span<const std::string> states) {
  Undivided out(world, std::move(engine), n);
  for (const std::string& state : states) {
    if (absl::Status s = out.engine_->Restore(state); !s.ok()) return s;
  }
  return out;
}

void Undivided::RunTo(Tick n) {
  std::vector<Input> inputs;
  while (tick_ < n) {
    inputs.clear();
    ScriptedInputs(*world_, ++tick_, &inputs);
    live_.AppendDue(tick_, &inputs);
    live_.ForgetBefore(tick_ + 1);
    std::sort(inputs.begin(), inputs.end());
    for (const Input& i : inputs) ApplyInput(i, engine_.get());
    engine_->Step(tick_);
  }
}

uint64_t Undivided::Hash() const {
  uint64_t sum = 0;
  for (BodyId id : engine_->Ids()) sum += BodyHash(id, engine_->Hash(id));
  return sum;
}

}  // namespace aureole
