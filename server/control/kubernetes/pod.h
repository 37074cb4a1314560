// The Pod of a region server: what is asked of the API server, and what is read from what it says. Pure functions.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "server/control/allocator.h"
#include "server/control/kubernetes/json.h"

namespace aureole::kubernetes {

inline constexpr char kWorldLabel[] = "aureole.dev/world", kRegionLabel[] = "aureole.dev/region",
                      kIncarnationLabel[] = "aureole.dev/incarnation";
inline constexpr int kRegionPort = 7000, kMetricsPort = 9100;

// Where a region's checkpoints are; the place belongs to the region, whichever of its servers runs.
struct Storage {
  enum class Kind : uint8_t { kEmptyDir, kHostPath, kVolumeClaim };
  Kind kind = Kind::kEmptyDir;
  std::string host_path = "";      // kHostPath: below it WORLD/region-R, made by the server, who must be allowed to
  std::string storage_class = "";  // kVolumeClaim; empty: the cluster's default
  std::string size = "";           // likewise: "1Gi"
  friend bool operator==(const Storage&, const Storage&) = default;
};

// What all Pods of a world have in common. The fields of JSON are as in a Pod; null: not given.
struct PodTemplate {
  std::string world, space, uid;  // the World that owns them
  std::string image = "", pull_policy = "";
  Json resources = nullptr, node_selector = nullptr, tolerations = nullptr;
  std::string service_account = "";
  Storage storage = {};
  std::vector<std::string> flags = {};                 // of every server: "--tls", DIR
  Json volumes = nullptr, mounts = nullptr;            // that the flags name; lists
  std::vector<std::vector<RegionId>> neighbours = {};  // by region
};

std::string PodName(const std::string& world, RegionId region, uint64_t incarnation);
std::string ClaimName(const std::string& world, RegionId region);

// One Pod per server, ended for good when the server ends. Where there is the choice: on a machine that has fewer of
// the world's Pods than others, and of those in the zone of its region's neighbours.
// It never runs on the nodes of `avoid`, which are named as in spec.nodeName.
Json PodManifest(const PodTemplate& pods, const ServerStart& start, const std::vector<std::string>& avoid = {});
// Of the region's storage, which goes with the World; nothing when it needs none.
std::optional<Json> ClaimManifest(const PodTemplate& pods, RegionId region);

// What a Pod says.
struct PodView {
  ServerStart start;             // `listen`: the Pod's address, empty until it has one
  std::string name, uid, owner;  // owner: uid of the World
  std::string node;              // empty: not scheduled
  bool avoids = false;           // nodes, as PodManifest says
  bool unschedulable = false;    // so far
  bool taken = false;            // its node has said something about it
  bool started = false;          // its server runs, or has
  bool leaving = false;          // deleted, but still there
  int leave_seconds = 0;         // that it has from the deletion on
  std::string waits;             // not started: why not, as far as it is said
};
// Nothing when it is no region server's.
std::optional<PodView> ReadPod(const Json& pod);

// How its server ended; nothing while it has not.
struct PodEnd {
  bool clean = false;
  std::string how;  // "exit status 137 (OOMKilled)", "Evicted: The node was low on resource: memory."
};
std::optional<PodEnd> EndOf(const Json& pod);

}  // namespace aureole::kubernetes
