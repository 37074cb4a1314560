// Where operators say how a world shall be divided, and see how it is: between their threads and the run's.
#pragma once

#include <functional>
#include <mutex>
#include <string>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/core/scene.h"
#include "server/core/world.h"

namespace aureole {

// Thread-safe; no call blocks.
class LayoutDesk {
 public:
  struct State {
    LayoutChange now;          // in force
    std::vector<Rect> wanted;  // by region; empty: nothing else
    // Regions that are no members any more, and whose servers have not ended yet.
    std::vector<RegionId> leaving;
    bool changing = false;  // `now` is not yet what was wanted, or a server is leaving
    std::string refused;    // why the newest change that came to nothing did so; it is tried again
  };

  // Of a world that begins, which outlives this.
  explicit LayoutDesk(const World& world);
  const World& world() const { return world_; }

  // Cells of equal size (EqualCells), and as little as possible changes hands (AssignCells). InvalidArgument names the
  // field; FailedPrecondition: the layout of this world cannot change.
  absl::Status Resize(int columns, int rows);
  // So many cells, unless there are as many already or will be: columns where the world begins in columns, else as
  // square as their number allows. Of equal size; with `weights`, by region, of about the same weight (BalancedCells).
  absl::Status ResizeTo(int regions, const std::vector<double>& weights = {});
  // A neighbour gets the region's area (WithoutArea), and its server leaves.
  absl::Status Drain(RegionId region);

  // What is wanted from here on; a change that is under way still comes into force before. `make` gets what is in force
  // or, when something else is wanted already, that. FailedPrecondition: the layout of this world cannot change; else
  // what `make` says.
  using Make = std::function<absl::StatusOr<std::vector<Rect>>(const LayoutChange& now, const State& state)>;
  absl::Status Want(const Make& make);
  State state() const;

  // Of the run.
  std::vector<Rect> wanted() const;
  void Publish(State state);

 private:
  const World& world_;
  mutable std::mutex mutex_;
  State state_;
};

}  // namespace aureole
