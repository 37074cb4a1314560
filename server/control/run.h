// One run of a world on servers of its own, from the first process to the last: what `aureole up`, `aureole experiment`
// and aureole-control have in common.
#pragma once

#include <atomic>
#include <chrono>
#include <functional>
#include <string>
#include <vector>

#include <absl/status/status.h>

#include "server/control/allocator.h"
#include "server/control/autoscaler.h"
#include "server/control/control_hub.h"
#include "server/control/control_service.h"
#include "server/control/event_log.h"
#include "server/control/layout_desk.h"
#include "server/control/run_event.h"
#include "server/control/run_status.h"
#include "server/control/world_store.h"
#include "server/transport/security.h"

namespace aureole {

struct RunOptions {
  v1::WorldSpec world;
  int regions = 1;  // of the world's layout
  bool undivided = false;
  bool no_real_time = false;
  Tick last_tick = 0;   // 0: until interrupted
  Tick hash_every = 0;  // ticks; 0: never
  // Ticks between checkpoints. With them, a server that dies or falls silent is replaced, and the run goes on bit for
  // bit; 0: the run ends with the first server that does.
  Tick checkpoint_every = 0;
  std::string listen = "127.0.0.1:0";
  // Servers join, and operators call, at this hub's port instead, which servers dial at `advertise`, host:port, with
  // `world_name`.
  ControlHub* hub = nullptr;
  std::string advertise = {}, world_name = {};
  // Kept there, the run outlives this control plane: the one that calls RunWorld next with the same store and world
  // finds the servers that still run, replaces those that do not, and goes on. Outlives the run.
  WorldStore* store = nullptr;
  // What operators want of the layout. Null: it stays as it is. Outlives the run.
  LayoutDesk* layouts = nullptr;
  // What happens, for those who watch. Null: known only while the run lasts. Outlives the run.
  EventLog* events = nullptr;
  ScalingOptions scaling = {};  // of the layout by the load, when it is on; needs `layouts` of a world that scales
  uint64_t control_epoch = 1;   // grows with each control plane of the world; servers obey no lower one
  // Once it is true, RunWorld returns and the servers go on without a control plane. Needs a store.
  const std::atomic<bool>* leave = nullptr;
  SecurityOptions security;                // of what listens here; the servers are started with theirs
  std::chrono::seconds join_timeout{120};  // from the start of the servers to the last Ready
  std::chrono::seconds stop_timeout{10};   // from Stop to the end of the last server, which is then killed
};

struct RunResult {
  RunStatus status;
  std::vector<TickSum> hashes;
  std::vector<std::vector<v1::Window>> windows;  // by region
  std::vector<v1::Violation> violations;         // the first 64
  double wall_seconds = 0;                       // from Start to the end
};

// Told of what happens to servers, as it happens; on the caller's thread.
using EventObserver = std::function<void(const RunEvent&)>;

// Called about ten times a second, on the caller's thread; false interrupts the run.
using RunObserver = std::function<bool(const RunStatus&)>;

// Runs until every region has finished, the observer says so, or something fails; in every case but `leave`, and the
// loss of the store, no server is left when it returns; a second interrupt (interrupts.h) makes short work of servers
// that take their time. `result` holds what was reported until then. Cancelled: the observer ended it. Aborted: a
// server ended or left before its time and could not be replaced; the message names the region, how it ended and the
// tail of its log. DeadlineExceeded: the servers did not join, or did not end, in time. Unavailable: the control
// plane's port cannot be opened; or what Security says: it must not be. FailedPrecondition: the store has another
// world. Aborted, Unavailable, DataLoss: the store's; the servers go on.
absl::Status RunWorld(const RunOptions& options, Allocator& allocator, const RunObserver& observe, RunResult* result,
                      const EventObserver& on_event = nullptr);

}  // namespace aureole
