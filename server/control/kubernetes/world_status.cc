#include "server/control/kubernetes/world_status.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/strings/str_join.h>
#include <absl/time/time.h>

namespace aureole::kubernetes {
namespace {

constexpr size_t kMostMessage = 2000;  // bytes

double Rounded(double value) { return std::round(value * 100) / 100; }

bool Here(const RegionStatus& r) { return r.finished || (r.joined && r.ready && !r.left); }

std::string PhaseOf(const RegionStatus& r, const PodView* pod, bool running) {
  if (r.finished) return "Finished";
  if (!r.member) return r.ready && r.report.tick() > 0 ? "Leaving" : "Joining";
  if (!r.joined || r.left) {
    if (pod != nullptr && !pod->started) return "Pending";
    return r.was_ready ? "Recovering" : "Starting";
  }
  if (!r.ready) return r.was_ready ? "Recovering" : "Loading";
  if (r.report.replaying()) return "Recovering";
  return running ? "Running" : "Ready";
}

// A side at infinity is left out, as in a world file.
Json HomeOf(const Rect& home) {
  Json out = Json::object();
  const std::pair<const char*, double> sides[] = {
      {"minX", home.min_x}, {"maxX", home.max_x}, {"minZ", home.min_z}, {"maxZ", home.max_z}};
  for (const auto& [name, at] : sides) {
    if (std::isfinite(at)) out[name] = at;
  }
  return out;
}

Json RegionOf(RegionId region, const Rect& home, const RegionStatus& r, const PodView* pod, bool running) {
  Json out = {{"region", region},
              {"incarnation", r.incarnation},
              {"phase", PhaseOf(r, pod, running)},
              {"bodies", r.report.bodies()},
              {"awake", r.report.awake()},
              {"frameMs", Rounded(r.frame.mean_ms())},
              {"dilation", Rounded(r.report.real_time_factor())},
              {"tick", r.report.tick()},
              {"home", HomeOf(home)}};
  if (!r.endpoint.empty()) out["endpoint"] = r.endpoint;
  if (pod == nullptr) return out;
  out["pod"] = pod->name;
  if (!pod->node.empty()) out["node"] = pod->node;
  if (!pod->waits.empty()) out["message"] = pod->waits;
  return out;
}

std::string Text(const std::vector<std::string>& parts) {
  std::string out = absl::StrJoin(parts, "; ");
  if (out.size() > kMostMessage) out.resize(kMostMessage);
  return out;
}

Condition Exact(const RunStatus& run) {
  int64_t violations = 0;
  for (const RegionStatus& r : run.regions) violations += r.report.violations();
  if (violations == 0) return {"Exact", true, "NoViolations", ""};
  return {"Exact", false, "Violations",
          absl::StrCat(violations, " times a body came nearer to another region's than was planned for")};
}

Condition Degraded(const RunStatus& run) {
  std::vector<std::string> missing, unprotected;
  for (size_t i = 0; i < run.regions.size(); ++i) {
    const RegionStatus& r = run.regions[i];
    if (run.start_unix_us != 0 && r.member && !Here(r)) missing.push_back(absl::StrCat("region ", i, " has no server"));
    if (!r.report.storage_failure().empty()) {
      unprotected.push_back(
          absl::StrCat("region ", i, " is not protected by checkpoints: ", r.report.storage_failure()));
    }
  }
  if (!missing.empty()) return {"Degraded", true, "RegionMissing", Text(missing)};
  if (!unprotected.empty()) return {"Degraded", true, "NotProtected", Text(unprotected)};
  return {"Degraded", false, "AllIsWell", ""};
}

}  // namespace

WorldStatus StatusOf(const WorldResource& world, const RunStatus& run, const std::map<RegionId, PodView>& pods) {
  WorldStatus out;
  out.generation = world.generation;
  const bool running = run.stage >= Stage::kRunning;
  Json regions = Json::array();
  std::vector<std::string> waits = run.Waiting();
  int here = 0, members = 0;
  bool replaying = false;
  double slowest = std::numeric_limits<double>::infinity();
  for (size_t i = 0; i < run.regions.size(); ++i) {
    const RegionStatus& r = run.regions[i];
    const auto pod = pods.find(static_cast<RegionId>(i));
    const PodView* const view = pod == pods.end() ? nullptr : &pod->second;
    if (!r.member && !Here(r) && view == nullptr) continue;  // it has left
    const Rect home = i < world.homes.size() ? world.homes[i] : Rect{};
    regions.push_back(RegionOf(static_cast<RegionId>(i), home, r, view, running));
    if (!r.member) continue;  // it comes, or goes
    ++members;
    here += Here(r) ? 1 : 0;
    replaying |= r.report.replaying();
    slowest = std::min(slowest, r.report.real_time_factor());
    if (!Here(r) && view != nullptr && !view->waits.empty()) {
      waits.push_back(absl::StrCat("region ", i, ": ", view->waits));
    }
  }
  const bool all = here == members;
  const std::string phase = run.stage == Stage::kFinished  ? "Finished"
                            : run.start_unix_us == 0       ? "Starting"
                            : all && running && !replaying ? "Running"
                                                           : "Recovering";
  out.fields = {{"phase", phase},
                {"tick", run.MinTick()},
                {"regionsReady", absl::StrCat(here, "/", members)},
                {"replicas", members},
                {"selector", absl::StrCat(kWorldLabel, "=", world.name)},
                {"bodies", run.Bodies()},
                {"awake", run.Awake()},
                {"realTimeFactor", std::isfinite(slowest) ? Rounded(slowest) : 0},
                {"regions", regions}};
  if (run.hash.complete()) {
    out.fields["hash"] = {
        {"tick", run.hash.tick}, {"hash", absl::StrFormat("%016x", run.hash.hash)}, {"bodies", run.hash.bodies}};
  }
  if (run.start_unix_us != 0) {
    out.fields["startTime"] =
        absl::FormatTime("%Y-%m-%dT%H:%M:%SZ", absl::FromUnixMicros(run.start_unix_us), absl::UTCTimeZone());
  }
  out.conditions = {{"Ready", phase == "Running", phase, Text(waits)}, Exact(run), Degraded(run)};
  return out;
}

WorldStatus StoppedStatus(int64_t generation, const std::string& phase, const std::string& reason,
                          const std::string& message) {
  WorldStatus out;
  out.generation = generation;
  out.fields = {{"phase", phase}};
  out.conditions = {{"Ready", false, reason, Text({message})}};
  return out;
}

Condition Applied(const std::string& not_applied) {
  return not_applied.empty() ? Condition{"Applied", true, "AsSpecified", ""}
                             : Condition{"Applied", false, "CannotChange", not_applied};
}

Json ConditionList(const Json& before, const WorldStatus& status, const std::string& now) {
  Json out = before.is_array() ? before : Json::array();
  for (const Condition& condition : status.conditions) {
    Json next = {
        {"type", condition.type},       {"status", condition.holds ? "True" : "False"}, {"reason", condition.reason},
        {"message", condition.message}, {"observedGeneration", status.generation},      {"lastTransitionTime", now}};
    const auto same = std::find_if(out.begin(), out.end(),
                                   [&](const Json& other) { return TextAt(other, {"type"}) == condition.type; });
    if (same == out.end()) {
      out.push_back(std::move(next));
      continue;
    }
    const std::string since = TextAt(*same, {"lastTransitionTime"});
    if ((*same)["status"] == next["status"] && !since.empty()) next["lastTransitionTime"] = since;
    *same = std::move(next);
  }
  return out;
}

}  // namespace aureole::kubernetes
