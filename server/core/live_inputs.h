// Inputs of clients: offered to any region, told to all with the exchange, applied by whoever holds the body.
//
// Every region hears the same inputs in the same order, so all know from the same tick on what will act and when, and
// it does not matter where a body is or who moves it meanwhile. Of each source only sequences that grow count: what a
// client repeats, here or at another region, acts once. Whoever applies an input says so with the exchange, so that
// every region knows what became of it.
#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <utility>
#include <vector>

#include <absl/status/status.h>

#include "server/core/frame.h"
#include "server/core/input_schedule.h"
#include "server/core/scene.h"

namespace aureole {

// What became of an input that was offered here.
struct InputOutcome {
  InputName name;
  Tick tick = 0;       // at whose start it took effect, or would have; 0: no longer known
  int64_t bodies = 0;  // on which it acted, in its first tick; 0: what it named was nowhere then
  BodyId body = 0;     // a spawn's

  bool applied() const { return bodies > 0; }
  friend bool operator==(const InputOutcome&, const InputOutcome&) = default;
};

// Bodies that clients spawn have ids from here on, in the order in which they are told.
inline constexpr BodyId kFirstLiveId = uint64_t{1} << 61;
inline bool IsLiveId(BodyId id) { return id >= kFirstLiveId && id < 2 * kFirstLiveId; }
// A force lasts at most so long.
inline constexpr Tick kMostInputTicks = 100'000;

// InvalidArgument when it cannot be an input of a client: not finite, without a target, no valid kind.
absl::Status CheckLiveInput(const Input& input);

class LiveInputs {
 public:
  // Most inputs that a region tells in one tick; more wait for the next.
  static constexpr size_t kMostPerTick = 1024;
  // Outcomes kept of each source, for what it repeats, and ticks after which those of a source that says nothing go.
  static constexpr size_t kKeptOutcomes = 8192;
  static constexpr Tick kKeptTicks = 4096;

  // Takes an input for the next exchange, after CheckLiveInput.
  absl::Status Offer(const Input& input);
  size_t offered() const { return offered_.size(); }

  // At most kMostPerTick of what was offered, in order, to be told to all.
  std::vector<Input> TakeOffered();
  // What a region told; it takes effect at tick `effect`, a spawn at tick `spawn_effect`. Called alike in every region:
  // same order, same ticks. `mine`: this region told it.
  void Deliver(const std::vector<Input>& inputs, Tick effect, Tick spawn_effect, bool mine);
  const InputSchedule& due() const { return due_; }
  // Forgets inputs of ticks before n.
  void ForgetBefore(Tick n) { due_.ForgetBefore(n); }

  // This region has applied it to so many bodies.
  void Applied(const Input& input, int64_t bodies);
  // What was applied here since the last call, to be told to all.
  std::vector<AppliedInput> TakeApplied() { return std::exchange(applied_, {}); }
  // A region, this one too, has applied these.
  void Heard(const std::vector<AppliedInput>& applied);
  // All regions have been heard about inputs up to this tick.
  void Settle(Tick n);

  // Since the last call: of inputs offered here, each time that one was offered.
  std::vector<InputOutcome> TakeOutcomes() { return std::exchange(outcomes_, {}); }
  // Since the last call: every input that will take effect, with its tick, the same in all regions.
  std::vector<Input> TakeDelivered() { return std::exchange(delivered_, {}); }

 private:
  struct Source {
    uint64_t last = 0;  // sequence delivered
    std::deque<InputOutcome> recent;
  };
  struct Open {
    int64_t bodies = 0;
    bool over_area = false;
    BodyId spawned = 0;
    int mine = 0;  // how often it was offered here
  };

  void Repeated(const Source& source, const InputName& name);
  void ForgetOutcomes(Tick n);

  std::deque<Input> offered_;
  InputSchedule due_;
  BodyId next_body_ = kFirstLiveId;
  std::map<std::pair<Tick, InputName>, Open> open_;  // not settled
  std::map<InputName, Tick> effect_;                 // of these
  std::map<uint64_t, Source> sources_;
  std::vector<AppliedInput> applied_;
  std::vector<InputOutcome> outcomes_;
  std::vector<Input> delivered_;
};

}  // namespace aureole
