// Where a control plane keeps what it, or the one that takes over from it, must know of a world. SqliteStore is a file;
// in a cluster it is the status of the World.
#pragma once

#include <optional>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "aureole/v1/world_record.pb.h"

namespace aureole {

// One thread at a time. May block for as long as a disk or an API server takes.
class WorldStore {
 public:
  virtual ~WorldStore() = default;

  // Nothing: no record yet. Unavailable, DataLoss: it cannot be read, and must not be taken for none.
  virtual absl::StatusOr<std::optional<v1::WorldRecord>> Load() = 0;
  // Replaces the record; it is durable when this returns OK. Unavailable: nothing has changed; try again. Aborted:
  // another control plane has the world.
  virtual absl::Status Save(const v1::WorldRecord& record) = 0;
};

}  // namespace aureole
