// The one kind of message on a link between two regions, as values. Transport turns it into protobuf and back.
#pragma once

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "server/core/scene.h"
#include "server/core/types.h"

namespace aureole {

// Closed box in single precision, rounded outward, so that it contains the box it was made from.
struct WireBox {
  float min[3] = {0, 0, 0};
  float max[3] = {0, 0, 0};
  friend bool operator==(const WireBox&, const WireBox&) = default;

  template <class Archive>
  void Visit(Archive& a) {
    a(min, max);
  }
};
WireBox RoundOutward(const Box& box);
Box Widen(const WireBox& box);

// What a region tells another of one of its bodies. Sent when it differs from what was last told on this link; kept by
// the receiver until a later frame replaces it or names it in `gone`. A sleeping body therefore costs nothing.
struct Aura {
  BodyId id = 0;
  WireBox box;  // k = 0: the exact box. k >= 1: the box of the bounding sphere, which turning does not change
  // k >= 1 only.
  RegionId owner = kNoRegion;  // after the decisions of the frame's tick
  // `reach` policy only (R12): the contact group that may strike the body within the horizon and the exchange, the
  // group's kinetic energy then at most, in J (rounded up), and the body's own mass in kg (rounded down).
  BodyId group = 0;
  float energy = 0;
  float mass = 0;
  friend bool operator==(const Aura&, const Aura&) = default;

  template <class Archive>
  void Visit(Archive& a) {
    a(id, box, owner, group, energy, mass);
  }
};

// Two bodies of different owners whose boxes meet, as the sender sees it (R16a).
struct Edge {
  BodyId a = 0, b = 0;  // a < b
  friend bool operator==(const Edge&, const Edge&) = default;

  template <class Archive>
  void Visit(Archive& archive) {
    archive(a, b);
  }
};

// A contact component of the sender's own bodies that others may have to know of (R16b).
struct Fragment {
  std::vector<BodyId> known;  // members that were told to anybody, or touch a foreign box; ascending, never empty
  BodyId id = 0;              // smallest id of all members
  uint32_t bodies = 0;        // all members
  std::vector<std::pair<RegionId, double>> mass_by_home;  // ascending by region; kg
  RegionId gives_back = kNoRegion;                        // R20: where it returns to, unless it has an edge

  template <class Archive>
  void Visit(Archive& a) {
    a(known, id, bodies, mass_by_home, gives_back);
  }
};

// A body that touches a region with which its owner exchanges no boxes yet.
struct LateAura {
  RegionId to = kNoRegion;
  Aura aura;

  template <class Archive>
  void Visit(Archive& a) {
    a(to, aura);
  }
};

// An input of a client that a region has applied, and to how many of its bodies.
struct AppliedInput {
  InputName name;
  int64_t bodies = 0;
  friend bool operator==(const AppliedInput&, const AppliedInput&) = default;

  template <class Archive>
  void Visit(Archive& a) {
    a(name, bodies);
  }
};

// What a region says to all in each tick: k = 0 by R16; k >= 1 the last two only. Nothing to say: it is not passed on.
struct Graph {
  RegionId of = kNoRegion;
  std::vector<Edge> edges;          // ascending
  std::vector<Fragment> fragments;  // ascending by their first known body
  std::vector<LateAura> late;       // ascending by `to`
  // Regions with which `of` begins, or ceases to need, to exchange boxes from the next tick on; ascending.
  std::vector<RegionId> opened, closed;
  // Inputs of clients offered to `of`, in the order in which they came; and those that `of` has applied.
  std::vector<Input> inputs;
  std::vector<AppliedInput> applied;
  // `of` has no area and no body left; said once, and true from then on.
  bool emptied = false;
  bool empty() const {
    return edges.empty() && fragments.empty() && late.empty() && opened.empty() && closed.empty() && inputs.empty() &&
           applied.empty() && !emptied;
  }

  template <class Archive>
  void Visit(Archive& a) {
    a(of, edges, fragments, late, opened, closed, inputs, applied, emptied);
  }
};

enum class TransferCause : uint8_t {
  kAuraCollision = 1,     // the paper's AC (Algorithm 1): joins what it may touch
  kBoundaryTraverse = 2,  // the paper's BT (Algorithm 2): an island goes home
  kDrain = 3,             // the region is being emptied
};

// Moves the ownership of a whole cluster. Whole, or not at all (P44).
struct Transfer {
  std::vector<BodyId> ids;    // ascending
  std::vector<Epoch> epochs;  // after the transfer, one per id
  TransferCause cause = TransferCause::kAuraCollision;
  std::string state;           // Engine::Extract; of state tick (k = 0), of state tick + k - 1 (k >= 1)
  std::vector<Input> pending;  // k >= 1: announced spawns among these bodies, in order
};

struct Away {
  BodyId id = 0;
  RegionId owner = kNoRegion;
  WireBox box;
  friend bool operator==(const Away&, const Away&) = default;

  template <class Archive>
  void Visit(Archive& a) {
    a(id, owner, box);
  }
};

// Rounds of the synchronous exchange within a tick. Graphs spread in two hops (server/core/allgather.h), and are made
// again when bodies touch a region that was not told of them (R15).
enum Round : int {
  kBoxes = 0,
  kGraphs = 1,
  kGraphsOn = 2,  // passed on
  kGraphsAgain = 3,
  kGraphsAgainOn = 4,
  kTransfers = 5,
  // After tick n, to the regions that join in tick n + 1: what all others know alike (division.h, live_inputs.h).
  kWelcome = 6,
};

struct Frame {
  RegionId from = kNoRegion;
  std::vector<RegionId> to;  // ascending, never empty; where it was received: the receiver
  Tick tick = 0;
  int round = 0;  // k = 0: of enum Round. k >= 1: 0
  std::vector<Aura> auras;
  std::vector<BodyId> gone;
  std::vector<Graph> graphs;  // those that are not empty; ascending by `of`
  std::vector<Transfer> transfers;
  std::string welcome;  // of that round; as archive.h writes it
  // k >= 1, as changes: boxes of the bodies that the sender projects and that are not wholly inside their owner's
  // region (PROTOCOL.md section 3c).
  std::vector<Away> away;
  std::vector<BodyId> away_gone;
};

}  // namespace aureole
