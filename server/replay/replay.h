// A recorded world, simulated again in one piece (proto/aureole/v1/recording.proto).
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <absl/container/flat_hash_set.h>
#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "aureole/v1/recording.pb.h"
#include "server/core/undivided.h"

namespace aureole {

// Gives each spawn its shape, which lists leave out where it is that of the spawn before.
void ExpandShapes(google::protobuf::RepeatedPtrField<v1::Input>* inputs);

class Replay {
 public:
  // One snapshot per region, of one tick and one world. InvalidArgument says what is wrong.
  static absl::StatusOr<std::unique_ptr<Replay>> Begin(const std::vector<v1::Snapshot>& snapshots);

  // Takes an input that acts after tick(), with its shape. InvalidArgument when it is none, or spawns a body again.
  absl::Status Add(const v1::Input& input);
  void RunTo(Tick n) { run_.RunTo(n); }

  Tick tick() const { return run_.tick(); }
  double tick_seconds() const { return world_->environment.dt(); }
  int64_t bodies() const { return run_.engine().Counts().bodies; }

  struct Difference {
    BodyId body = 0;
    // 0: the body is not there.
    uint64_t recorded = 0, simulated = 0;
  };
  // The smallest body whose state is not that of the recording, which has these hashes of all bodies; nothing: all are
  // equal, bit for bit.
  std::optional<Difference> Compare(const std::map<BodyId, uint64_t>& recorded) const;

 private:
  Replay(std::unique_ptr<World> world, Undivided run) : world_(std::move(world)), run_(std::move(run)) {}

  const std::unique_ptr<World> world_;
  Undivided run_;
  absl::flat_hash_set<BodyId> spawned_;  // or to be
};

}  // namespace aureole
