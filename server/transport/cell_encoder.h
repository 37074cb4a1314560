// Cells as bytes: what has changed from one state of a cell to another (simulation.proto: Cell).
#pragma once

#include <map>
#include <string>
#include <vector>

#include <absl/container/flat_hash_map.h>

#include "server/core/region.h"
#include "server/transport/cell_state.h"

namespace aureole {

// Where bodies went that are here no more, by id: the last time.
using Fates = absl::flat_hash_map<BodyId, BodyChanges::Gone>;

struct EncodedCell {
  std::string bytes;                  // a serialised Cell; empty when nothing has changed
  std::vector<BodyId> entered, left;  // ascending
};

// The change from `base` (null: an empty cell) to `state` (null: likewise; not both), as seen at `tick`. Both are of
// the same cell and format. Pure; cost linear in the bodies of both.
EncodedCell EncodeCell(const CellState* base, const CellState* state, const CellFormat& format, const Fates& fates,
                       Tick tick);

}  // namespace aureole
