// What a region owns, and the bookkeeping that both exchanges share: the engine, epochs, arrivals, inputs, counters.
#pragma once

#include <deque>
#include <memory>
#include <span>
#include <utility>
#include <vector>

#include <absl/container/flat_hash_map.h>
#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/core/archive.h"
#include "server/core/division.h"
#include "server/core/engine.h"
#include "server/core/frame.h"
#include "server/core/live_inputs.h"
#include "server/core/region.h"
#include "server/core/world.h"

namespace aureole {

// A body that this region owns.
struct Held {
  Epoch epoch = 0;
  Tick arrived = -1000000;  // tick at which it was transferred here; long ago for what began here
  int64_t transfer = 0;     // with which it came: the count of transfers here; 0: it began here

  template <class Archive>
  void Visit(Archive& a) {
    a(epoch, arrived, transfer);
  }
};

// Frames of one peer that wait for their phase.
class Inbox {
 public:
  // InvalidArgument unless the frame can follow the last one: ticks and rounds only grow; with a delay, without holes.
  // `now` is the last tick that was stepped here.
  absl::Status Accept(Frame frame, Tick now, bool synchronous);
  const Frame* Front() const { return frames_.empty() ? nullptr : &frames_.front(); }
  Frame Pop();
  // Frames popped since the peer became a member.
  uint64_t taken() const { return taken_; }
  // The peer is no member any more. What waits is of a life to come.
  void Renew() {
    taken_ = 0;
    taken_tick_ = -1;
    taken_round_ = kTransfers;
  }

  // As far as frames were popped: those that wait are not in it, and come again.
  template <class Archive>
  void Visit(Archive& a) {
    a(taken_, taken_tick_, taken_round_);
    if constexpr (std::is_same_v<Archive, Reader>) {
      frames_.clear();
      tick_ = taken_tick_;
      round_ = taken_round_;
    }
  }

 private:
  std::deque<Frame> frames_;
  Tick tick_ = -1, taken_tick_ = -1;  // of the last one accepted, and popped
  int round_ = kTransfers, taken_round_ = kTransfers;
  uint64_t taken_ = 0;
};

struct Holdings {
  Holdings(const World& w, RegionId s, std::unique_ptr<Engine> e, Division d);

  const World& world;
  const RegionId self;
  std::unique_ptr<Engine> engine;
  Division division;
  Rect rect;                                     // of self, by the layout in force
  std::vector<RegionId> peers;                   // the other members, ascending
  absl::flat_hash_map<RegionId, Inbox> inboxes;  // of all peers, and of others whose frames came early
  absl::flat_hash_map<BodyId, Held> held;
  Tick tick = 0;  // last stepped
  RegionStats stats;
  std::vector<Violation> violations;
  bool watched = false;  // changes are noted
  BodyChanges changes;

  std::vector<Input> pending;  // k >= 1: announced spawns of owned bodies that have not taken effect, in Input's order
  LiveInputs live;

  const Layout& layout() const { return division.now().layout; }
  // After now() of the division has changed: the rectangle, the peers and their inboxes.
  void FollowDivision();
  // Adds bodies and joints of state 0 that this region owns.
  void LoadInitialState(double margin);
  // Every input that takes effect at the start of tick n, of the script and of clients, in Input's order, appended. The
  // same in all regions; it is for the region that holds the body, or is the home of the spawn, to apply it.
  void AppendInputs(Tick n, std::vector<Input>* out) const;
  // Applies it to what it means of the bodies here; a spawn always.
  void Apply(const Input& input);
  // Gives up owned bodies for a new owner.
  Transfer Depart(std::vector<BodyId> ids, RegionId to, TransferCause cause);
  // Takes over what a peer sent.
  void Arrive(const Transfer& transfer, RegionId from, Tick n);
  void Report(const Violation& v);
  // Before the step of tick n: which newcomers now touch one that did not come with them.
  void MeasureSlack(Tick n);
  // Home crossings and bodies away from home among `near` (ascending ids of the bodies that may be either).
  void CountHomes(std::span<const BodyId> near);

  // What decides the future, after a tick, and the counters. Load: into new holdings without bodies; false when the
  // bytes are not what Save wrote.
  void Save(Writer& a) const;
  bool Load(Reader& a);

 private:
  // Bodies that came to be with others and have met none yet, and with which transfer.
  std::vector<std::pair<BodyId, int64_t>> newcomers_;
  std::vector<BodyId> touched_;
  std::vector<std::pair<BodyId, RegionId>> homes_;  // of the bodies near the border, ascending
};

// Region with the larger value, ties to the better rank; kNoRegion for an empty list.
RegionId Heaviest(const Layout& layout, std::span<const std::pair<RegionId, double>> mass);
// Adds to the entry of `home`, keeping the list ascending.
void AddMass(std::vector<std::pair<RegionId, double>>* mass, RegionId home, double kg);

// Whether what the frame says of regions fits the division of its tick: InvalidArgument names the field.
absl::Status CheckRegions(const Frame& frame, const Division::State& division);

// The exchange of a region: synchronous (k = 0) or with a fixed delay (k >= 1). Same meaning as in Region.
class Protocol {
 public:
  virtual ~Protocol() = default;
  virtual Phase phase() const = 0;
  virtual bool Ready() const = 0;
  virtual void Missing(std::vector<RegionId>* out) const = 0;
  virtual void Advance(std::vector<Frame>* out) = 0;
  // Whether a frame of this round can come from that peer in a tick that is divided so.
  virtual bool MaySend(RegionId peer, int round, const Division::State& division) const = 0;
  // Appends what is in flight from here: stepped by nobody's engine in tick `tick() + 1` (before its step), or in state
  // `tick()`.
  virtual void ObserveInFlight(std::vector<BodyRecord>* out) const = 0;
  // Appends at most so many of the boxes that peers hold of bodies here, each body once.
  virtual void AppendAuras(size_t most, std::vector<WireBox>* out) const = 0;
  // After a tick: what it knows beside the holdings.
  virtual void Save(Writer& a) const = 0;
  virtual void Load(Reader& a) = 0;
};

// `joins`: the region joins a world that runs, and begins at Phase::kJoin.
std::unique_ptr<Protocol> MakeSyncExchange(Holdings& holdings, bool joins);
std::unique_ptr<Protocol> MakeDelayedExchange(Holdings& holdings);

}  // namespace aureole
