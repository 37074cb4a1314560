// The topics of a recording (MCAP), and reading one.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include <absl/status/statusor.h>

#include "aureole/v1/recording.pb.h"
#include "aureole/v1/simulation.pb.h"

namespace aureole {

// Messages and their times: of the simulation, tick x length of a tick.
//   /world            aureole.v1.GetWorldResponse, with its scene; first
//   /region/N/snapshot aureole.v1.Snapshot, one
//   /region/N/hashes  aureole.v1.StateHashes
//   /region/N/frames  aureole.v1.ReplicaFrame, as StreamReplicas sends them
//   /region/N/status  aureole.v1.RegionStatus
//   /inputs           aureole.v1.Input, every input of a client that takes effect
inline constexpr char kWorldTopic[] = "/world", kInputsTopic[] = "/inputs";
std::string RegionTopic(int region, const std::string& what);

// What is needed to simulate a recording again.
struct RecordedRun {
  bool whole = false;  // the file has its end
  std::optional<v1::GetWorldResponse> world;
  std::vector<v1::Snapshot> snapshots;
  std::vector<v1::Input> inputs;
  // The bodies' hashes by tick, where all regions have told theirs, by the layout with which the recording begins.
  std::map<int64_t, std::map<uint64_t, uint64_t>> hashes;
};
absl::StatusOr<RecordedRun> ReadRecording(const std::string& path);

}  // namespace aureole
