// Inputs of clients: offered to any region, told to all with the exchange, applied by whoever holds the body.
//
// Every region hears the same inputs in the same order, so all know from the same tick on what will act and when, and
// it does not matter where a body is or who moves it meanwhile. Of each source only sequences that grow count: what a
// client repeats, here or at another region, acts once. What is remembered is bounded, by the same rule everywhere:
// when there are too many clients, the one that was silent for longest is forgotten, but none that has just spoken.
// Whoever applies an input says so with the exchange, so that every region knows what became of it.
#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include <absl/container/flat_hash_map.h>
#include <absl/status/status.h>

#include "server/core/archive.h"
#include "server/core/division.h"
#include "server/core/frame.h"
#include "server/core/input_schedule.h"
#include "server/core/limits.h"
#include "server/core/scene.h"

namespace aureole {

// What became of an input that was offered here.
struct InputOutcome {
  InputName name;
  Tick tick = 0;       // at whose start it took effect, or would have; 0: no longer known
  int64_t bodies = 0;  // on which it acted, in its first tick; 0: what it named was nowhere then
  BodyId body = 0;     // a spawn's
  bool full = false;   // it does not act: the world has as many clients, bodies of clients, or forces as it may
  // Of a change of the layout: why it has no effect. Empty: it is in force from `tick` on.
  std::string refused = {};

  bool applied() const { return bodies > 0; }
  friend bool operator==(const InputOutcome&, const InputOutcome&) = default;

  template <class Archive>
  void Visit(Archive& a) {
    a(name, tick, bodies, body, full, refused);
  }
};

// Bodies that clients spawn have ids from here on, in the order in which they are told.
inline constexpr BodyId kFirstLiveId = uint64_t{1} << 61;
inline bool IsLiveId(BodyId id) { return id >= kFirstLiveId && id < 2 * kFirstLiveId; }
// A force lasts at most so long.
inline constexpr Tick kMostInputTicks = 100'000;

// InvalidArgument when it cannot be an input of a client, or of the control plane: not finite, without a target, no
// valid kind.
absl::Status CheckLiveInput(const Input& input);

// What an input costs beside others: one over an area as much as many, since it may act on many bodies.
inline int CostOf(const Input& input) { return input.over_area() ? 64 : 1; }
// About how many bytes it takes when it is told after `before` (null: first): copies of a body share their shape.
size_t BytesOf(const Input& input, const Input* before);

// How much may be remembered. The same in all regions of a world.
struct LiveLimits {
  size_t clients = size_t{1} << 16;
  int64_t bodies = limits::kMaxBodies;  // of clients, at once
  size_t outcomes = size_t{1} << 18;    // for those who repeat inputs
  int lasting = 4096;                   // forces that act at once, by CostOf
};

class LiveInputs {
 public:
  // What a region tells in one tick, by CostOf and BytesOf; more waits for the next. Always one input at least.
  static constexpr int kMostPerTick = 1024;
  static constexpr size_t kMostBytesPerTick = size_t{1} << 20;
  // Outcomes are kept for so many ticks, and clients that say nothing at least so long.
  static constexpr Tick kKeptTicks = 4096;

  // Changes of the layout go to `division`, which outlives this; null: they have no effect.
  explicit LiveInputs(LiveLimits limits = {}, Division* division = nullptr) : limits_(limits), division_(division) {}

  // Takes an input for the next exchange, after CheckLiveInput.
  absl::Status Offer(const Input& input);
  size_t offered() const { return offered_.size(); }

  // Of what was offered, in order, what may be told to all in one tick.
  std::vector<Input> TakeOffered();
  // What a region told; it takes effect at tick `effect`, a spawn at tick `spawn_effect`, a change of the layout
  // kLayoutNotice after the tick before `effect`. Called alike in every region: same order, same ticks. `mine`: this
  // region told it.
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

  // What all regions know alike, for one that joins them: it then knows it too.
  void Teach(Writer& a) const { const_cast<LiveInputs*>(this)->VisitCommon(a); }
  void Learn(Reader& a);

  // All but the limits.
  template <class Archive>
  void Visit(Archive& a) {
    VisitCommon(a);
    a(offered_, applied_, outcomes_, delivered_);
  }

 private:
  template <class Archive>
  void VisitCommon(Archive& a) {
    a(due_, bodies_, lasting_, lasting_cost_, next_body_, open_, effect_, sources_, by_silence_, recent_, outcome_of_);
  }

  struct Source {
    uint64_t last = 0;  // sequence delivered
    Tick heard = 0;     // when it took effect

    template <class Archive>
    void Visit(Archive& a) {
      a(last, heard);
    }
  };
  struct Open {
    int64_t bodies = 0;
    bool over_area = false;
    bool removes_live = false;  // a body that a client spawned
    bool full = false;
    BodyId spawned = 0;
    std::string refused;
    int mine = 0;  // how often it was offered here

    template <class Archive>
    void Visit(Archive& a) {
      a(bodies, over_area, removes_live, full, spawned, refused, mine);
    }
  };

  Source* Find(uint64_t source, Tick effect);
  bool TakeLasting(const Input& input, Tick effect);
  void ChangeLayout(const Input& told, Tick effect, bool mine);
  void Repeated(const InputName& name);
  void Keep(const InputOutcome& outcome);

  const LiveLimits limits_;
  Division* const division_;
  std::deque<Input> offered_;
  InputSchedule due_;
  int64_t bodies_ = 0;                // of clients
  std::multimap<Tick, int> lasting_;  // what forces cost, by their last tick
  int lasting_cost_ = 0;
  BodyId next_body_ = kFirstLiveId;
  std::map<std::pair<Tick, InputName>, Open> open_;  // not settled
  std::map<InputName, Tick> effect_;                 // of these
  absl::flat_hash_map<uint64_t, Source> sources_;
  std::set<std::pair<Tick, uint64_t>> by_silence_;           // when each was heard last; clients only
  std::deque<InputOutcome> recent_;                          // ticks ascend
  absl::flat_hash_map<InputName, InputOutcome> outcome_of_;  // of these
  std::vector<AppliedInput> applied_;
  std::vector<InputOutcome> outcomes_;
  std::vector<Input> delivered_;
};

}  // namespace aureole
