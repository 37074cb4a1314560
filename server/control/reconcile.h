// What the control plane does about its servers, as a pure function of what it sees: no clock, no process, no socket.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "server/core/types.h"

namespace aureole {

// One region, as it is seen now.
struct RegionObserved {
  uint64_t incarnation = 0;  // of the newest server that was started for it; 0: none yet
  bool alive = false;        // the allocator runs that server
  bool joined = false;       // it has said Hello
  bool connected = false;    // its stream is open
  bool finished = false;     // it has reported its last tick
  bool clean = false;        // not alive: it ended with exit status 0
  double silent_s = 0;       // since it was last heard of, or was started
  double down_s = 0;         // not alive: since it ended
  int failures = 0;          // servers in a row that ended without getting the region further than it was before
  std::string how;           // not alive: how it ended
  bool adopted = false;      // an earlier control plane started it: it knows where to join again
  bool wanted = true;        // the region is to have a server
  bool leaves = false;       // it ends by itself, with exit status 0, and then the region is to have none
  bool joins = false;        // no server of the region was started since it was given its name
  bool member = true;        // the world waits for it
};

struct Observed {
  bool recovers = false;  // regions make checkpoints
  bool over = false;      // every region has finished, or was told to stop
  std::vector<RegionObserved> regions;
};

struct Action {
  enum class Kind {
    kStart,  // a server with this incarnation, which fences all older ones
    kEnd,    // the server with this incarnation, at once
    kGiveUp  // the run cannot go on
  };
  Kind kind = Kind::kStart;
  RegionId region = kNoRegion;
  uint64_t incarnation = 0;
  std::string why;
};

// A server whose stream has ended, or that says nothing for so long, is replaced; so is one that an earlier control
// plane has left and that does not join again. Far above what a server that is stopped for a moment, or pages, needs.
inline constexpr double kExitAfterLeaveSeconds = 3, kLeaseSeconds = 6, kRejoinSeconds = 10;
// Servers of one region that may end in a row without getting further before the run gives up (P74), and the wait
// before the next one after n of them: 0.1 s, doubled each time, at most 10 s.
inline constexpr int kMostFailures = 6;
double BackOffSeconds(int failures);

std::vector<Action> Reconcile(const Observed& observed);

}  // namespace aureole
