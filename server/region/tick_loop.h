// The tick thread of a region server: paces the region by the wall clock, moves frames between it and the links, and
// measures and reports what happens.
#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <functional>
#include <mutex>
#include <set>
#include <string>
#include <vector>

#include "aureole/v1/control.pb.h"
#include "server/core/region.h"
#include "server/region/checkpoint.h"
#include "server/region/frame_clock.h"
#include "server/region/journal.h"
#include "server/region/region_links.h"

namespace aureole {

class TickLoop {
 public:
  struct Options {
    // Tick n begins no earlier than `start_unix_us` (wall time of tick 0) plus n tick lengths. Ticks that are late run
    // at once; the simulation then runs slower than real time, which the reports' real_time_factor says.
    bool real_time = true;
    int64_t start_unix_us = 0;
    Tick last_tick = 0;      // 0: runs until Stop
    int64_t hash_every = 0;  // ticks; 0: only the last tick is hashed
    // With a journal.
    int64_t checkpoint_every = 0;  // ticks
    uint64_t world_hash = 0;
    // The region was loaded from a checkpoint: what it did after it is done again, as fast as it can, with these
    // inputs.
    bool recovered = false;
    std::vector<LoggedInput> replay;
    std::vector<Checkpoint::Hash> hashes;  // reported again
  };
  // All called on the tick thread.
  struct Hooks {
    std::function<std::vector<Input>()> inputs;  // before a tick whose exchange has room: what clients offer
    std::function<void(const std::vector<InputOutcome>&)> outcomes;
    std::function<void(const FrameSample&)> after_tick;
    // After each tick, with the clients' inputs that were delivered in it.
    std::function<void(Region*, int64_t bodies, const std::vector<Input>& delivered)> publish;
    std::function<bool(const v1::Report&)> report;  // false: nobody has heard it
    // May be null. After the last report, the same with all hashes that may not have been heard: what is said to a
    // control plane that comes later.
    std::function<void(const v1::Report&, bool heard)> epilogue;
    std::function<void(const std::string&)> log;  // waits over 1 s, violations, refused frames
    std::function<void()> fenced;                 // with a journal: a later incarnation has taken over; the loop ends
    std::function<void()> gone;                   // the region has left, and nobody needs its frames; the loop ends
  };

  // All outlive the loop. `journal`: null for none.
  TickLoop(const World& world, Region* region, RegionLinks* links, Journal* journal, Options options, Hooks hooks);

  // Runs to the last tick, until the region has left, or until Stop; then sends a last report. A region that joins
  // waits for its welcome first; one that has left stays until nobody needs its frames. True when the last tick was
  // reached.
  bool Run();
  // From any thread. A change of the layout, offered to the region like an input of a client.
  void Offer(const Input& change);
  // From any thread. With a journal: a checkpoint after tick n, or as soon after it as the last one is written.
  void SaveAt(Tick n);
  // From any thread, also before Run; Run returns soon after.
  void Stop();
  // From any thread: the next report says the newest hashes again, which may not have been heard.
  void SayAgain() { say_again_ = true; }
  // From any thread: of the newest report.
  Tick reported_tick() const { return said_tick_; }
  int64_t reported_bodies() const { return said_bodies_; }

 private:
  using Clock = RegionLinks::Clock;

  bool Join();
  void Leave();
  void FollowLayout();
  bool SleepUntilDue(Tick n);
  bool RunTick();
  void OfferInputs();
  void Submit(const Input& input);
  void TellDurable();
  bool IsAskedToSave();
  void Checkpoint(Tick after);
  void EndReplay();
  void AddHash(const aureole::Checkpoint::Hash& h);
  void AppendHash(const aureole::Checkpoint::Hash& h);
  void AppendRecentHashes();
  void KeepUnsaid();
  bool AwaitPeers();
  void Take(Clock::time_point deadline);
  void EndLap();
  void AfterTick();
  void Report(const std::vector<RegionId>& waiting_for, bool finished);

  const World& world_;
  Region* const region_;
  RegionLinks* const links_;
  Journal* const journal_;
  const Options options_;
  const Hooks hooks_;
  std::atomic<bool> stopped_ = false, say_again_ = false;
  std::atomic<Tick> said_tick_;
  std::atomic<int64_t> said_bodies_;
  std::mutex offers_mutex_;
  std::vector<Input> offers_;
  std::set<Tick> save_at_;

  FrameClock clock_;
  WindowMeter windows_;
  std::vector<Frame> in_, out_;
  std::vector<RegionId> missing_;
  v1::Report pending_;  // hashes, windows and violations since the last report
  std::vector<double> frames_since_report_;
  Clock::time_point start_;    // of tick 0
  Tick lap_of_ = 0;            // the tick whose lap runs; 0: none
  bool replaying_ = false;     // repeats what an earlier incarnation did
  size_t replayed_ = 0;        // of options_.replay
  std::vector<Input> logged_;  // being made durable, for the next tick
  bool alone_said_ = false;    // inputs that were told are not in the copy
  Tick checkpointed_ = 0;
  Tick log_until_ = 0;           // of all regions that were loaded with this one
  uint64_t followed_epoch_ = 0;  // 0: none yet
  Tick followed_next_ = 0;
  std::deque<aureole::Checkpoint::Hash> recent_hashes_;  // that may not have reached the control plane
  Clock::duration longest_pause_{}, lost_{};
  Clock::time_point reported_at_;
  Tick reported_tick_ = 0;
  int64_t waits_ = 0;
  Clock::duration waited_{};
  int64_t refused_ = 0;
  int64_t body_ticks_ = 0, away_body_ticks_ = 0;
};

}  // namespace aureole
