// What the tick thread takes of a region for those who watch it: the bodies in watched cells that are awake, or that
// have just come, gone, slept or left. Nothing while nobody watches.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include <absl/container/flat_hash_set.h>

#include "server/core/region.h"
#include "server/transport/cell_state.h"

namespace aureole {

// Cells from `low` to `high` in x and in z, both included.
struct CellRect {
  CellKey low, high;
  bool Contains(const CellKey& c) const { return c.x >= low.x && c.x <= high.x && c.z >= low.z && c.z <= high.z; }
};
// Few rectangles that cover these cells, each once, and nothing else. Cost: n log n.
std::vector<CellRect> RectsOf(std::vector<CellKey> cells);

// What is watched, and when. Immutable.
struct Watch {
  uint64_t generation = 0;    // grows with every watch
  std::vector<Tick> periods;  // captures are due at multiples of any
  bool everything = false;    // else the cells
  absl::flat_hash_set<CellKey> cells;
  std::vector<CellRect> rects;  // of the cells

  bool Contains(const CellKey& cell) const { return everything || cells.contains(cell); }
};

struct Capture {
  struct Fresh {
    BodyId id = 0;
    Epoch epoch = 0;
    BodyLook look;
  };
  Tick tick = 0;
  std::shared_ptr<const Watch> watch;
  bool first = false;                   // forget what was captured before
  std::vector<BodyPose> poses;          // ascending ids
  std::vector<Fresh> fresh;             // of bodies that may be new to the reader; ascending
  std::vector<BodyChanges::Gone> gone;  // in order
};

// One thread at a time.
class ReplicaCapture {
 public:
  // Whether a capture is due after tick n. Constant time.
  bool Due(const Watch& watch, Tick n) const;
  // Cost: linear in the bodies that are awake or, when few cells are watched, in the bodies there (with a logarithm of
  // all); and once in all bodies of a cell that was not watched before.
  void Take(Region* region, std::shared_ptr<const Watch> watch, Capture* out);
  // Nobody watches.
  void Stop(Region* region);

 private:
  void TakeAwake(const Engine& engine, const Watch& watch, std::vector<BodyPose>* out) const;
  void TakeRects(const Engine& engine, const std::vector<CellRect>& rects, std::vector<BodyPose>* out) const;

  std::shared_ptr<const Watch> watch_;  // of the capture before; null: none
  std::vector<BodyId> last_;            // captured then in watched cells, but for those at rest; ascending
};

}  // namespace aureole
