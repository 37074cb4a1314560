#include "server/control/kubernetes/world_resource.h"

#include <algorithm>
#include <utility>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/time/time.h>

#include "server/control/world_file.h"
#include "server/core/limits.h"
#include "server/transport/world_json.h"
#include "server/transport/world_spec.h"

namespace aureole::kubernetes {
namespace {

constexpr size_t kMostName = 40;          // so that the names of Pods and claims fit in a label
constexpr double kMostCheckpoint = 3600;  // seconds
constexpr const char* kFixed[] = {"storage", "checkpointSeconds", "duration", "hashEvery", "realTime", "policy"};

absl::Status Refuse(const std::string& field, const std::string& what) {
  return absl::InvalidArgumentError(absl::StrCat("spec.", field, ": ", what));
}

// What is wrong with the world's text, after where it is.
absl::Status InWorld(const std::string& where, const absl::Status& s) {
  return absl::InvalidArgumentError(absl::StrCat(where, s.message()));
}

absl::Status ReadStorage(const Json& spec, Storage* out) {
  const Json* const storage = Find(spec, {"storage"});
  const char* const kinds[] = {"hostPath", "volumeClaim", "emptyDir"};
  const auto given = std::count_if(std::begin(kinds), std::end(kinds), [&](const char* kind) {
    return Find(spec, {"storage", kind}) != nullptr;
  });
  if (storage == nullptr || given != 1) {
    return Refuse("storage", "must have exactly one of hostPath, volumeClaim and emptyDir");
  }
  if (const Json* const path = Find(*storage, {"hostPath"})) {
    out->kind = Storage::Kind::kHostPath;
    if (path->is_string()) out->host_path = path->get<std::string>();
    if (!absl::StartsWith(out->host_path, "/")) return Refuse("storage.hostPath", "must be a directory, from / on");
  } else if (const Json* const claim = Find(*storage, {"volumeClaim"})) {
    out->kind = Storage::Kind::kVolumeClaim;
    out->storage_class = TextAt(*claim, {"storageClassName"});
    const Json* const size = Find(*claim, {"size"});
    if (size == nullptr || !(size->is_string() || size->is_number_integer())) {
      return Refuse("storage.volumeClaim.size", "must be a quantity of bytes, such as \"1Gi\"");
    }
    out->size = size->is_string() ? size->get<std::string>() : size->dump();
  }
  return absl::OkStatus();
}

absl::Status ReadRun(const Json& spec, int64_t tick_us, RunOptions* out) {
  if (const Json* const real_time = Find(spec, {"realTime"}); real_time != nullptr) {
    if (!real_time->is_boolean()) return Refuse("realTime", "must be true or false");
    out->no_real_time = !real_time->get<bool>();
  }
  if (Find(spec, {"duration"}) != nullptr) {
    absl::Duration length;
    if (!absl::ParseDuration(TextAt(spec, {"duration"}), &length) || length <= absl::ZeroDuration() ||
        length == absl::InfiniteDuration()) {
      return Refuse("duration", "must be a time such as \"60s\" or \"2m\"; without end when not given");
    }
    out->last_tick = TicksIn(absl::ToDoubleSeconds(length), tick_us);
  }
  if (Find(spec, {"hashEvery"}) != nullptr) {
    out->hash_every = IntegerAt(spec, {"hashEvery"}).value_or(-1);
    if (out->hash_every < 0) return Refuse("hashEvery", "must be a number of ticks, 0 for none");
  }
  double seconds = 1;
  if (const Json* const every = Find(spec, {"checkpointSeconds"}); every != nullptr) {
    seconds = every->is_number() ? every->get<double>() : 0;
    if (!(seconds > 0 && seconds <= kMostCheckpoint)) {
      return Refuse("checkpointSeconds", absl::StrCat("must be above 0, at most ", kMostCheckpoint,
                                                      "; a region without checkpoints could not be replaced"));
    }
  }
  out->checkpoint_every = TicksIn(seconds, tick_us);
  if (const std::string policy = TextAt(spec, {"policy"}); !policy.empty() && policy != "Wait") {
    return Refuse("policy", absl::StrCat("is ", policy, "; only Wait is possible: regions wait for the next server"));
  }
  return absl::OkStatus();
}

absl::Status ReadPods(const Json& spec, const PodDefaults& defaults, PodTemplate* out) {
  const auto taken = [&](const char* field) {
    const Json* const value = Find(spec, {field});
    return value == nullptr ? Json() : *value;
  };
  out->image = TextAt(spec, {"image"});
  if (out->image.empty()) out->image = defaults.image;
  if (out->image.empty()) return Refuse("image", "is missing, and the control plane has none of its own to take");
  out->pull_policy = TextAt(spec, {"imagePullPolicy"});
  if (out->pull_policy.empty() && TextAt(spec, {"image"}).empty()) out->pull_policy = defaults.pull_policy;
  out->resources = taken("resources");
  out->node_selector = taken("nodeSelector");
  out->tolerations = taken("tolerations");
  out->service_account = TextAt(spec, {"serviceAccountName"});
  out->flags = defaults.flags;
  out->volumes = defaults.volumes;
  out->mounts = defaults.mounts;
  return absl::OkStatus();
}

absl::Status ReadTime(const Json& regions, const char* field, std::chrono::milliseconds* out) {
  if (Find(regions, {field}) == nullptr) return absl::OkStatus();
  absl::Duration time;
  if (!absl::ParseDuration(TextAt(regions, {field}), &time)) {
    return Refuse(absl::StrCat("regions.", field), "must be a time such as \"5s\" or \"2m\"");
  }
  *out = absl::ToChronoMilliseconds(time);
  return absl::OkStatus();
}

// A number that an int holds; what is none, or too small, is -1.
int NumberAt(const Json& regions, const char* field, int otherwise) {
  if (Find(regions, {field}) == nullptr) return otherwise;
  return static_cast<int>(std::clamp<int64_t>(IntegerAt(regions, {field}).value_or(-1), -1, 1 << 30));
}

// spec.regions, all of it, also where the world does not scale itself.
absl::StatusOr<ScalingOptions> ReadScaling(const Json& spec) {
  ScalingOptions out;
  out.min_regions = 1;
  out.max_regions = limits::kMaxRegions;
  const Json* const regions = Find(spec, {"regions"});
  if (regions == nullptr) return out;
  out.min_regions = NumberAt(*regions, "min", out.min_regions);
  out.max_regions = NumberAt(*regions, "max", out.max_regions);
  out.frame_percent = NumberAt(*regions, "framePercent", out.frame_percent);
  out.awake_bodies = NumberAt(*regions, "awakeBodies", 0);
  if (absl::Status s = ReadTime(*regions, "upAfter", &out.up_after); !s.ok()) return s;
  if (absl::Status s = ReadTime(*regions, "downAfter", &out.down_after); !s.ok()) return s;
  if (absl::Status s = CheckScaling(out); !s.ok()) return InWorld("spec.regions.", s);
  return out;
}

absl::Status ReadReplicas(const Json& spec, const World& world, WorldResource* out) {
  const absl::StatusOr<ScalingOptions> scaling = ReadScaling(spec);
  if (!scaling.ok()) return scaling.status();
  const int least = scaling->min_regions, most = scaling->max_regions;
  // Bounds alone, without a max, are for people.
  if (Find(spec, {"regions", "max"}) != nullptr && least < most) {
    if (absl::Status s = CheckScales(*scaling, world); !s.ok()) return Refuse("regions", std::string(s.message()));
    out->scaling = *scaling;
  }
  int64_t wanted = world.layout.size();
  if (Find(spec, {"replicas"}) != nullptr) {
    wanted = IntegerAt(spec, {"replicas"}).value_or(0);
    if (wanted < 1 || wanted > limits::kMaxRegions || (!out->scaling.on() && (wanted < least || wanted > most))) {
      return Refuse("replicas", absl::StrFormat("is %d; regions allows %d to %d", wanted, least, most));
    }
    out->replicas_given = static_cast<int>(wanted);
  } else if (!out->scaling.on() && (wanted < least || wanted > most)) {
    return Refuse("replicas",
                  absl::StrFormat("is %d, as the layout has regions; regions allows %d to %d", wanted, least, most));
  }
  wanted = std::clamp<int64_t>(wanted, least, most);
  out->replicas = static_cast<int>(wanted);
  return absl::OkStatus();
}

}  // namespace

std::vector<std::vector<RegionId>> Neighbours(const std::vector<Rect>& homes) {
  std::vector<std::vector<RegionId>> out(homes.size());
  for (size_t a = 0; a < homes.size(); ++a) {
    for (size_t b = 0; b < homes.size(); ++b) {
      const Rect &p = homes[a], &q = homes[b];
      if (a != b && p.HasArea() && q.HasArea() && p.min_x <= q.max_x && q.min_x <= p.max_x && p.min_z <= q.max_z &&
          q.min_z <= p.max_z) {
        out[a].push_back(static_cast<RegionId>(b));
      }
    }
  }
  return out;
}

Resource WorldsOf(const std::string& space) { return {kWorldGroup, kWorldVersion, "worlds", space}; }

std::optional<WorldSource> SourceOf(const Json& object) {
  WorldSource source{TextAt(object, {"spec", "worldFrom", "configMap"}), TextAt(object, {"spec", "worldFrom", "key"})};
  if (source.config_map.empty() || source.key.empty()) return std::nullopt;
  return source;
}

absl::StatusOr<WorldResource> ReadWorld(const Json& object, const std::optional<std::string>& file,
                                        const PodDefaults& defaults) {
  WorldResource out;
  out.name = TextAt(object, {"metadata", "name"});
  out.space = TextAt(object, {"metadata", "namespace"});
  out.uid = TextAt(object, {"metadata", "uid"});
  out.generation = IntegerAt(object, {"metadata", "generation"}).value_or(0);
  if (out.name.size() > kMostName || absl::StrContains(out.name, '.')) {
    return absl::InvalidArgumentError(absl::StrCat("metadata.name: must have at most ", kMostName,
                                                   " characters, and no '.': Pods are named after it"));
  }
  const Json* const spec = Find(object, {"spec"});
  if (spec == nullptr) return absl::InvalidArgumentError("spec: is missing");
  const Json* const world = Find(*spec, {"world"});
  const bool from = Find(*spec, {"worldFrom"}) != nullptr;
  if ((world != nullptr) == from) return Refuse("world", "must be given, or worldFrom; not both");
  std::string where = "spec.world.";
  if (from) {
    const std::optional<WorldSource> source = SourceOf(object);
    if (!source) return Refuse("worldFrom", "must have configMap and key");
    where = absl::StrCat("spec.worldFrom: ", source->config_map, "/", source->key, ": ");
    if (!file) return InWorld(where, absl::NotFoundError("there is no such ConfigMap, or it has no such key"));
  }
  absl::StatusOr<v1::WorldSpec> parsed = SpecFromJson(from ? *file : ToText(*world));
  if (!parsed.ok()) return InWorld(where, parsed.status());
  const absl::StatusOr<World> checked = WorldFromSpec(*parsed);
  if (!checked.ok()) return InWorld(where, checked.status());

  out.run.regions = checked->layout.size();
  out.run.world_name = out.name;
  for (RegionId r = 0; r < out.run.regions; ++r) out.homes.push_back(checked->layout.rect(r));
  out.world_hash = absl::StrFormat("%016x", WorldHash(*parsed));
  out.run.world = *std::move(parsed);
  out.pods.world = out.name;
  out.pods.space = out.space;
  out.pods.uid = out.uid;
  out.pods.neighbours = Neighbours(out.homes);
  if (absl::Status s = ReadRun(*spec, checked->environment.tick_us, &out.run); !s.ok()) return s;
  if (absl::Status s = ReadStorage(*spec, &out.pods.storage); !s.ok()) return s;
  if (absl::Status s = ReadPods(*spec, defaults, &out.pods); !s.ok()) return s;
  if (absl::Status s = ReadReplicas(*spec, *checked, &out); !s.ok()) return s;
  out.fixed = Json::object();
  for (const char* field : kFixed) {
    if (const Json* const value = Find(*spec, {field}); value != nullptr) out.fixed[field] = *value;
  }
  return out;
}

Json WithFixed(Json object, const Json& fixed) {
  Json& spec = object["spec"];
  for (const char* field : kFixed) {
    if (const Json* const value = Find(fixed, {field}); value != nullptr) {
      spec[field] = *value;
    } else {
      spec.erase(field);
    }
  }
  return object;
}

}  // namespace aureole::kubernetes
