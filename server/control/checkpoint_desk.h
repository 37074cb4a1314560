// Where operators ask for checkpoints of a whole world, and hear when all are durable: between their threads and the
// run's.
#pragma once

#include <chrono>
#include <functional>
#include <mutex>
#include <vector>

#include <absl/status/status.h>

#include "aureole/v1/control_plane.pb.h"
#include "server/control/run_status.h"

namespace aureole {

// Thread-safe; no call blocks.
class CheckpointDesk {
 public:
  static constexpr size_t kMostWaiting = 16;
  // Called once, on any thread, perhaps at once; it must not call the desk. FailedPrecondition: there can be no such
  // checkpoints. Unavailable: a region cannot write them, or the run is over. ResourceExhausted.
  using Done = std::function<void(const absl::Status&, const v1::SaveCheckpointResponse&)>;

  // `every`: ticks between the checkpoints that the run makes anyway; 0: it makes none. `tick_us`: length of a tick.
  CheckpointDesk(Tick every, int64_t tick_us);
  // Close before: nobody waits.
  ~CheckpointDesk();
  CheckpointDesk(const CheckpointDesk&) = delete;
  CheckpointDesk& operator=(const CheckpointDesk&) = delete;

  // `copied`: durable at the regions' keepers, too.
  void Ask(bool copied, Done done);

  // Of the run, at each look. `save` tells a region to make a checkpoint after a tick; as often as it may not have
  // heard.
  void Step(const RunStatus& status, const std::function<void(RegionId, Tick)>& save);
  // The run is over: who waits hears so, and who asks from here on.
  void Close();

 private:
  using Clock = std::chrono::steady_clock;
  struct Wish {
    bool copied = false;
    Done done = nullptr;
    Tick tick = 0;  // 0: none was chosen yet
    Clock::time_point asked = {};
  };

  // True when the wish has been answered.
  bool Serve(Wish* wish, const RunStatus& status, const std::function<void(RegionId, Tick)>& save) const;

  const Tick every_, margin_;
  std::mutex mutex_;
  std::vector<Wish> wishes_;
  bool closed_ = false;
};

}  // namespace aureole
