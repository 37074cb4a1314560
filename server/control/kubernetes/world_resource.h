// A World object, read: what to run and the Pods to run it in. Pure functions.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include <absl/status/statusor.h>

#include "server/control/kubernetes/json.h"
#include "server/control/kubernetes/pod.h"
#include "server/control/kubernetes/resource.h"
#include "server/control/run.h"
#include "server/core/types.h"

namespace aureole::kubernetes {

inline constexpr char kWorldGroup[] = "aureole.dev", kWorldVersion[] = "v1alpha1", kWorldKind[] = "World";
Resource WorldsOf(const std::string& space);

// Where spec.worldFrom points to.
struct WorldSource {
  std::string config_map, key;
};
// Nothing when the world is in the object itself, or the field is not as it should be.
std::optional<WorldSource> SourceOf(const Json& object);

// What a World that does not say otherwise gets, and what no World says: how servers prove who they are.
struct PodDefaults {
  std::string image = "", pull_policy = "";
  std::vector<std::string> flags = {};
  Json volumes = nullptr, mounts = nullptr;
};

struct WorldResource {
  std::string name, space, uid;
  int64_t generation = 0;
  RunOptions run;           // without what joins it to this process: hub, store, epoch
  PodTemplate pods;         // may change while the world runs, for the Pods to come; not its storage
  std::vector<Rect> homes;  // by region, in the layout with which the world begins
  int replicas = 0;         // wanted number of regions
  int replicas_given = 0;   // as the World has it, which may be out of its bounds where it scales itself; 0: not at all
  ScalingOptions scaling;   // on, where the world scales itself
  Json fixed;               // what cannot change while the world runs, but for the world itself
  std::string world_hash;   // of the world itself, in hex
};

// `file`: the text that SourceOf points to. InvalidArgument "spec.storage: ...", with the remedy, for the first value
// that is not sane; nothing is said of values that the API server refuses by itself (k8s/base/worlds.yaml).
absl::StatusOr<WorldResource> ReadWorld(const Json& object, const std::optional<std::string>& file,
                                        const PodDefaults& defaults);

// By region: those whose rectangles touch its own, if only in a point.
std::vector<std::vector<RegionId>> Neighbours(const std::vector<Rect>& homes);

// The object, but with `fixed` of another one.
Json WithFixed(Json object, const Json& fixed);

}  // namespace aureole::kubernetes
