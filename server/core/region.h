// One region of a world: a state machine that steps its bodies and exchanges frames with its peers. No clock, thread,
// socket, file or log; the whole distributed run is a pure function of the world and of the accepted inputs.
//
// A tick runs in phases. Each phase needs certain frames of the peers; Advance runs it and yields frames to send:
//   k = 0   kBegin: inputs; boxes to those that are open to this region.  kGraph: needs their boxes; own graph to the
//           row.  kRelay: needs the row's graphs; passes them on.  kDecide: needs the other rows' graphs; transfers, or
//           once more from kRelay on when a box was told late.  kArrive: needs the transfers of those that send one.
//           kStep.
//           Before the first tick, kJoin: a region that joins a running world needs the welcome of a peer. After the
//           last, kLeft: a region that is no member any more; it is never ready again.
//   k >= 1  kBegin: needs the frames of tick n-k of all; applies them and the inputs.  kStep: steps, detects, decides,
//           -> the frames of tick n.
// (PROTOCOL.md sections 4 and 10; the tick order is P22.)
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/core/engine.h"
#include "server/core/frame.h"
#include "server/core/live_inputs.h"
#include "server/core/world.h"

namespace aureole {

enum class Phase : uint8_t { kBegin, kGraph, kRelay, kDecide, kArrive, kStep, kJoin, kLeft };

inline constexpr Tick kSlackTicks = 32;

// Counters since the start. "Touching": the cluster had more than one body.
struct RegionStats {
  int64_t transfers_out = 0, transfers_in = 0;
  int64_t bodies_out = 0, bodies_in = 0;
  int64_t touching_out = 0;           // transfers of clusters of at least two bodies
  int64_t returns_out = 0;            // of transfers_out, those of cause kBoundaryTraverse
  int64_t largest_cluster = 0;        // most bodies in one transfer
  int64_t largest_component = 0;      // most bodies of one merged component that touched more than one owner (k = 0)
  int64_t longest_chain = 0;          // most owners met in one component
  int64_t auras_sent = 0;             // aura updates, all links
  int64_t auras_told = 0;             // auras that peers hold of us now
  int64_t aura_tests = 0;             // bodies tested against other regions or foreign boxes
  int64_t exchanges_ended_early = 0;  // k = 0: ticks without a third exchange
  int64_t graphs_again = 0;           // k = 0: ticks in which somebody told a box late
  int64_t home_crossings = 0;
  int64_t away_bodies = 0;  // owned now, centre outside the home rectangle
  // Slack at first touch (PROTOCOL.md section 8): bodies that came here to be with others, by the ticks until the box
  // of one first met one that had not come with it. [kSlackTicks]: none within so many ticks.
  std::array<int64_t, kSlackTicks + 1> slack{};
  int64_t violations = 0;  // broken horizons (I4), each also in Region::violations()

  template <class Archive>
  void Visit(Archive& a) {
    a(transfers_out, transfers_in, bodies_out, bodies_in, touching_out, returns_out, largest_cluster, largest_component,
      longest_chain, auras_sent, auras_told, aura_tests, exchanges_ended_early, graphs_again, home_crossings,
      away_bodies, slack, violations);
  }
};

// A horizon that was broken: two bodies that were stepped apart although their exact boxes met.
struct Violation {
  Tick tick = 0;
  BodyId own = 0, foreign = 0;
  double depth = 0;  // m
  double speed = 0;  // m/s, the faster of the two
};

// One body as an observer sees it. For tests, hashes and clients; not for the tick.
struct BodyRecord {
  BodyId id = 0;
  Epoch epoch = 0;
  uint64_t hash = 0;
  // Bodies with equal groups are stepped together in the next step. Regions are 0..n-1; a cluster in flight that is
  // stepped on its own has a group of its own, negative.
  int64_t group = 0;
  Box box;
};

// Bodies that came to a region and went, for those who watch it.
struct BodyChanges {
  struct Gone {
    BodyId id = 0;
    RegionId to = kNoRegion;  // kNoRegion: removed
    Epoch epoch = 0;          // that it has there
    Tick from = 0;            // the first state in which it is there
    Vec3 at = Vec3::Zero();   // where it was, m
  };
  std::vector<BodyId> came;         // spawned or transferred here; may be gone again
  std::vector<Gone> gone;           // in the order in which they went; may have come again
  std::vector<BodyId> slept, woke;  // fell asleep, woke up; may have done the other since, or be gone
};

// What decides a region's future, after a tick.
struct RegionSnapshot {
  std::string state;           // Engine::Save of all bodies
  std::vector<Input> to_come;  // inputs of clients that act after it
};

class Region {
 public:
  // `engine` holds the world's environment and no dynamic body; the region loads its share of the initial state.
  // `world` outlives the region.
  Region(const World& world, RegionId self, std::unique_ptr<Engine> engine);
  // The region that Save wrote, at the end of the tick after which it did, in the same phase. `engine` as above.
  // InvalidArgument when the bytes are not of this region and world.
  static absl::StatusOr<std::unique_ptr<Region>> Load(const World& world, RegionId self, std::unique_ptr<Engine> engine,
                                                      std::string_view saved);
  // A region that joins a world that runs (k = 0), with the layout that the change describes: one that does not name
  // `self` as a member now, and will when it is in force. Empty, and at Phase::kJoin until then; from the tick on in
  // which the layout takes effect it is as any other. When the change comes to nothing, the region does.
  // InvalidArgument names the field.
  static absl::StatusOr<std::unique_ptr<Region>> Join(const World& world, RegionId self, std::unique_ptr<Engine> engine,
                                                      const LayoutChange& change);
  ~Region();
  Region(const Region&) = delete;
  Region& operator=(const Region&) = delete;

  RegionId self() const;
  // The last tick that was stepped.
  Tick tick() const;
  Phase phase() const;
  // Every region this one may exchange frames with, ascending: all other members.
  const std::vector<RegionId>& peers() const;
  // What is in force in the tick that has begun, or at kBegin in the one that was stepped; at kJoin what will be then.
  const Layout& layout() const;
  uint64_t layout_epoch() const;
  const std::vector<RegionId>& members() const;
  // What will be, from tick next_layout_at() on; 0: no change is pending.
  Tick next_layout_at() const;
  const Layout& next_layout() const;
  const std::vector<RegionId>& next_members() const;

  // Takes the next frame of a peer. Frames of one peer come in the order it sent them, each once. InvalidArgument when
  // the frame cannot be one of the protocol's (wrong sender, tick, round, box, id); then nothing changes. A peer may be
  // ahead, under a layout that is not in force here yet, and may be one that joins with it.
  absl::Status Receive(Frame frame);
  // Whether Advance may be called. At kBegin the caller also decides when it is time for the tick.
  bool Ready() const;
  // Peers whose frame the next phase still needs, ascending, appended.
  void Missing(std::vector<RegionId>* out) const;
  // Runs one phase and appends the frames to send. Precondition: Ready().
  void Advance(std::vector<Frame>* out);

  // Takes an input of a client (source > 0) for any body of the world, wherever it is. It is told to all regions with
  // the next exchange and takes effect at the start of the tick after that one (k = 0), or as many ticks later as the
  // delay demands; nothing is known of the body until then. Sequences of one source must grow: one that does not has
  // been taken before, here or elsewhere, and acts only once. InvalidArgument names the field; then nothing changes.
  // A change of the layout (source kControlSource; k = 0) is in force kLayoutNotice ticks after all have heard of it,
  // or its outcome says why it is not.
  // A region that leaves has no outcomes of what it told in its last tick, nor of what still waited: clients ask again
  // elsewhere.
  absl::Status Submit(const Input& input);
  // Of what was submitted, that which waits for an exchange with room for it.
  size_t inputs_waiting() const;
  // Since the last call: what became of what was submitted here, each time that it was.
  std::vector<InputOutcome> TakeOutcomes();
  // Since the last call: every client's input that takes effect, with its tick, in order of delivery; the same in all
  // regions, and known before that tick's step.
  std::vector<Input> TakeDelivered();

  // All bodies that this region accounts for: at kStep those that it is about to step, else those of state tick();
  // k >= 1: also those in flight from here that are not yet applied elsewhere.
  void Observe(std::vector<BodyRecord>* out) const;
  // Sum over these bodies of a hash of (id, hash): add the regions' values to get the world's (I6).
  uint64_t StateHash() const;

  // Together with those of the other regions after the same tick it is the state of the world. Preconditions: k = 0,
  // and the phase is kBegin. Linear in the bodies.
  RegionSnapshot Snapshot() const;

  // All that decides this region's future, after a tick: given the frames of its peers that it has not taken yet, and
  // the inputs that are offered to it from here on, a region that is loaded from this does bit for bit what this one
  // does. Precondition: the phase is kBegin or kLeft. Linear in the bodies. Appends.
  void SaveTo(std::string* out) const;
  std::string Save() const;
  // Frames of this peer that were taken by phases since the beginning of the world, by this region and those that it
  // was loaded from. Those that only wait are not in Save, and must come again after Load. Counted anew when a peer
  // that had left is a member again.
  uint64_t FramesTaken(RegionId peer) const;

  // At most so many of the boxes that peers hold of this region's bodies, each body once, in no order. Linear in them.
  void AppendAuras(size_t most, std::vector<WireBox>* out) const;

  // From here on changes are noted; they cost memory until they are taken.
  void WatchChanges(bool on);
  // Since the last call.
  BodyChanges TakeChanges();
  // Precondition: it is in the engine.
  Epoch EpochOf(BodyId id) const;

  // Bodies owned, announced spawns included. Constant time.
  int64_t bodies() const;
  const RegionStats& stats() const;
  // Since the last call, at most 64.
  std::vector<Violation> TakeViolations();
  const Engine& engine() const;

 private:
  struct Impl;
  explicit Region(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace aureole
