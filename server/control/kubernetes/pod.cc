#include "server/control/kubernetes/pod.h"

#include <utility>

#include <absl/strings/numbers.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_join.h>

namespace aureole::kubernetes {
namespace {

constexpr char kServer[] = "aureole-region", kData[] = "/data";
constexpr int kUser = 65532, kGraceSeconds = 30;  // more than a server takes to leave (--leave-within)
// For the scheduler to weigh. Machines come first: one Pod more on a machine weighs more than all neighbours in its
// zone, of which a grid has 8.
constexpr int kApart = 100, kNear = 10;
constexpr char kHost[] = "kubernetes.io/hostname", kZone[] = "topology.kubernetes.io/zone";

Json Labels(const PodTemplate& pods, const ServerStart& start) {
  return {{"app.kubernetes.io/name", kServer},
          {"app.kubernetes.io/part-of", "aureole"},
          {"app.kubernetes.io/managed-by", "aureole-control"},
          {kWorldLabel, pods.world},
          {kRegionLabel, absl::StrCat(start.region)},
          {kIncarnationLabel, absl::StrCat(start.incarnation)}};
}

Json OwnedBy(const PodTemplate& pods) {
  return Json::array({{{"apiVersion", "aureole.dev/v1alpha1"},
                       {"kind", "World"},
                       {"name", pods.world},
                       {"uid", pods.uid},
                       {"controller", true},
                       {"blockOwnerDeletion", true}}});
}

Json Affinity(const PodTemplate& pods, RegionId region) {
  const auto weigh = [&](const char* topology, Json more, int weight) {
    Json selector = {{"matchLabels", {{kWorldLabel, pods.world}}}};
    if (!more.is_null()) selector["matchExpressions"] = Json::array({std::move(more)});
    const Json term = {{"topologyKey", topology}, {"labelSelector", selector}};
    return Json{{"preferredDuringSchedulingIgnoredDuringExecution",
                 Json::array({{{"weight", weight}, {"podAffinityTerm", term}}})}};
  };
  Json affinity = {{"podAntiAffinity", weigh(kHost, nullptr, kApart)}};
  Json neighbours = Json::array();
  if (static_cast<size_t>(region) < pods.neighbours.size()) {
    for (const RegionId r : pods.neighbours[static_cast<size_t>(region)]) neighbours.push_back(absl::StrCat(r));
  }
  if (!neighbours.empty()) {
    affinity["podAffinity"] = weigh(kZone, {{"key", kRegionLabel}, {"operator", "In"}, {"values", neighbours}}, kNear);
  }
  return affinity;
}

// By the nodes' names, as their labels may say something else; a term takes only one name per requirement.
Json Elsewhere(const std::vector<std::string>& avoid) {
  Json fields = Json::array();
  for (const std::string& node : avoid) {
    fields.push_back({{"key", "metadata.name"}, {"operator", "NotIn"}, {"values", Json::array({node})}});
  }
  return {{"requiredDuringSchedulingIgnoredDuringExecution",
           {{"nodeSelectorTerms", Json::array({{{"matchFields", fields}}})}}}};
}

// The weights above are held against each other only; this one counts against how full machines are, too.
Json Spread(const PodTemplate& pods) {
  return Json::array({{{"maxSkew", 1},
                       {"topologyKey", kHost},
                       {"whenUnsatisfiable", "ScheduleAnyway"},
                       {"labelSelector", {{"matchLabels", {{kWorldLabel, pods.world}}}}}}});
}

// A host's directory is shared by all that is on the host, so the region has one of its own in it.
std::string DataDirectory(const PodTemplate& pods, RegionId region) {
  if (pods.storage.kind != Storage::Kind::kHostPath) return kData;
  return absl::StrCat(kData, "/", pods.world, "/region-", region);
}

Json DataVolume(const PodTemplate& pods, RegionId region) {
  switch (pods.storage.kind) {
    case Storage::Kind::kHostPath:
      return {{"name", "data"}, {"hostPath", {{"path", pods.storage.host_path}, {"type", "DirectoryOrCreate"}}}};
    case Storage::Kind::kVolumeClaim:
      return {{"name", "data"}, {"persistentVolumeClaim", {{"claimName", ClaimName(pods.world, region)}}}};
    case Storage::Kind::kEmptyDir:
      break;
  }
  return {{"name", "data"}, {"emptyDir", Json::object()}};
}

Json Appended(Json list, const Json& more) {
  if (more.is_array()) list.insert(list.end(), more.begin(), more.end());
  return list;
}

Json Container(const PodTemplate& pods, const ServerStart& start) {
  std::vector<std::string> args = {"--control", start.control,
                                   "--world",   pods.world,
                                   "--token",   start.token,
                                   "--listen",  absl::StrCat("$(POD_IP):", kRegionPort),
                                   "--metrics", absl::StrCat("$(POD_IP):", kMetricsPort),
                                   "--data",    DataDirectory(pods, start.region)};
  args.insert(args.end(), pods.flags.begin(), pods.flags.end());
  // Variables are not expanded here: the program takes the host from $POD_IP.
  std::vector<std::string> check = {"/bin/aureole-region", "--health-check", absl::StrCat(":", kRegionPort)};
  check.insert(check.end(), pods.flags.begin(), pods.flags.end());
  Json container = {
      {"name", "region"},
      {"image", pods.image},
      {"command", {"/bin/aureole-region"}},
      {"args", args},
      {"env", Json::array({{{"name", "POD_IP"}, {"valueFrom", {{"fieldRef", {{"fieldPath", "status.podIP"}}}}}}})},
      {"ports", Json::array({{{"name", "grpc"}, {"containerPort", kRegionPort}},
                             {{"name", "metrics"}, {"containerPort", kMetricsPort}}})},
      {"volumeMounts",
       Appended(Json::array({{{"name", "data"}, {"mountPath", kData}}, {{"name", "tmp"}, {"mountPath", "/tmp"}}}),
                pods.mounts)},
      {"readinessProbe", {{"exec", {{"command", check}}}, {"periodSeconds", 3}, {"timeoutSeconds", 5}}},
      {"livenessProbe",
       {{"tcpSocket", {{"port", "grpc"}}}, {"initialDelaySeconds", 10}, {"periodSeconds", 10}, {"timeoutSeconds", 5}}},
      {"securityContext",
       {{"allowPrivilegeEscalation", false}, {"readOnlyRootFilesystem", true}, {"capabilities", {{"drop", {"ALL"}}}}}}};
  if (!pods.pull_policy.empty()) container["imagePullPolicy"] = pods.pull_policy;
  if (!pods.resources.is_null()) container["resources"] = pods.resources;
  return container;
}

// The only container, when its status is known.
const Json* ContainerStatus(const Json& pod) {
  const Json* const all = Find(pod, {"status", "containerStatuses"});
  return all != nullptr && all->is_array() && !all->empty() ? &all->front() : nullptr;
}

// "Reason: what it means", of which either may be missing.
std::string Words(const Json& object) {
  const std::string reason = TextAt(object, {"reason"}), message = TextAt(object, {"message"});
  return absl::StrCat(reason, reason.empty() || message.empty() ? "" : ": ", message);
}

// What the scheduler says of a Pod that it finds no node for; null when it has not said so.
const Json* Unschedulable(const Json& pod) {
  const Json* const conditions = Find(pod, {"status", "conditions"});
  if (conditions == nullptr || !conditions->is_array()) return nullptr;
  for (const Json& condition : *conditions) {
    if (TextAt(condition, {"type"}) == "PodScheduled" && TextAt(condition, {"status"}) == "False") return &condition;
  }
  return nullptr;
}

std::string WhyNotStarted(const Json& pod) {
  if (const Json* const condition = Unschedulable(pod); condition != nullptr) {
    return absl::StrCat("cannot be scheduled: ", TextAt(*condition, {"message"}));
  }
  const Json* const status = ContainerStatus(pod);
  const Json* const waiting = status == nullptr ? nullptr : Find(*status, {"state", "waiting"});
  return waiting == nullptr ? "" : absl::StrCat("cannot start: ", Words(*waiting));
}

// The value after a flag; empty when there is none.
std::string FlagValue(const Json& pod, const std::string& flag) {
  const Json* const containers = Find(pod, {"spec", "containers"});
  if (containers == nullptr || !containers->is_array() || containers->empty()) return "";
  const Json* const args = Find(containers->front(), {"args"});
  if (args == nullptr || !args->is_array()) return "";
  for (size_t i = 0; i + 1 < args->size(); ++i) {
    if ((*args)[i] == flag && (*args)[i + 1].is_string()) return (*args)[i + 1].get<std::string>();
  }
  return "";
}

}  // namespace

std::string PodName(const std::string& world, RegionId region, uint64_t incarnation) {
  return absl::StrCat(world, "-r", region, "-i", incarnation);
}

std::string ClaimName(const std::string& world, RegionId region) { return absl::StrCat(world, "-region-", region); }

Json PodManifest(const PodTemplate& pods, const ServerStart& start, const std::vector<std::string>& avoid) {
  const Json volumes = Json::array({DataVolume(pods, start.region), {{"name", "tmp"}, {"emptyDir", Json::object()}}});
  Json spec = {{"restartPolicy", "Never"},
               {"automountServiceAccountToken", false},
               {"enableServiceLinks", false},
               {"terminationGracePeriodSeconds", kGraceSeconds},
               {"securityContext",
                {{"runAsNonRoot", true},
                 {"runAsUser", kUser},
                 {"runAsGroup", kUser},
                 {"fsGroup", kUser},
                 {"seccompProfile", {{"type", "RuntimeDefault"}}}}},
               {"affinity", Affinity(pods, start.region)},
               {"topologySpreadConstraints", Spread(pods)},
               {"volumes", Appended(volumes, pods.volumes)},
               {"containers", Json::array({Container(pods, start)})}};
  if (!avoid.empty()) spec["affinity"]["nodeAffinity"] = Elsewhere(avoid);
  if (!pods.service_account.empty()) spec["serviceAccountName"] = pods.service_account;
  if (!pods.node_selector.is_null()) spec["nodeSelector"] = pods.node_selector;
  if (!pods.tolerations.is_null()) spec["tolerations"] = pods.tolerations;
  return {{"apiVersion", "v1"},
          {"kind", "Pod"},
          {"metadata",
           {{"name", PodName(pods.world, start.region, start.incarnation)},
            {"namespace", pods.space},
            {"labels", Labels(pods, start)},
            {"ownerReferences", OwnedBy(pods)}}},
          {"spec", spec}};
}

std::optional<Json> ClaimManifest(const PodTemplate& pods, RegionId region) {
  if (pods.storage.kind != Storage::Kind::kVolumeClaim) return std::nullopt;
  Json spec = {{"accessModes", {"ReadWriteOnce"}}, {"resources", {{"requests", {{"storage", pods.storage.size}}}}}};
  if (!pods.storage.storage_class.empty()) spec["storageClassName"] = pods.storage.storage_class;
  return Json{{"apiVersion", "v1"},
              {"kind", "PersistentVolumeClaim"},
              {"metadata",
               {{"name", ClaimName(pods.world, region)},
                {"namespace", pods.space},
                {"labels", {{kWorldLabel, pods.world}, {kRegionLabel, absl::StrCat(region)}}},
                {"ownerReferences", OwnedBy(pods)}}},
              {"spec", spec}};
}

std::optional<PodView> ReadPod(const Json& pod) {
  PodView view;
  if (!absl::SimpleAtoi(TextAt(pod, {"metadata", "labels", kRegionLabel}), &view.start.region) ||
      !absl::SimpleAtoi(TextAt(pod, {"metadata", "labels", kIncarnationLabel}), &view.start.incarnation) ||
      view.start.region < 0) {
    return std::nullopt;
  }
  view.start.token = FlagValue(pod, "--token");
  view.start.control = FlagValue(pod, "--control");
  if (const std::string ip = TextAt(pod, {"status", "podIP"}); !ip.empty()) {
    view.start.listen = absl::StrCat(ip, ":", kRegionPort);
  }
  view.name = TextAt(pod, {"metadata", "name"});
  view.uid = TextAt(pod, {"metadata", "uid"});
  if (const Json* const owners = Find(pod, {"metadata", "ownerReferences"}); owners && owners->is_array()) {
    for (const Json& owner : *owners) {
      if (TextAt(owner, {"kind"}) == "World") view.owner = TextAt(owner, {"uid"});
    }
  }
  view.node = TextAt(pod, {"spec", "nodeName"});
  view.avoids = Find(pod, {"spec", "affinity", "nodeAffinity"}) != nullptr;
  view.unschedulable = Unschedulable(pod) != nullptr;
  const Json* const status = ContainerStatus(pod);
  view.taken = status != nullptr || !TextAt(pod, {"status", "startTime"}).empty();
  view.started = status != nullptr &&
                 (Find(*status, {"state", "running"}) != nullptr || Find(*status, {"state", "terminated"}) != nullptr);
  if (!view.started) view.waits = WhyNotStarted(pod);
  view.leaving = !TextAt(pod, {"metadata", "deletionTimestamp"}).empty();
  view.leave_seconds = static_cast<int>(IntegerAt(pod, {"metadata", "deletionGracePeriodSeconds"}).value_or(0));
  return view;
}

std::optional<PodEnd> EndOf(const Json& pod) {
  const std::string phase = TextAt(pod, {"status", "phase"}), reason = TextAt(pod, {"status", "reason"}),
                    message = TextAt(pod, {"status", "message"});
  if (phase == "Unknown" || reason == "NodeLost") {
    return PodEnd{false, absl::StrCat("node lost", message.empty() ? "" : ": ", message)};
  }
  if (phase == "Failed" && !reason.empty()) return PodEnd{false, Words(pod["status"])};
  const Json* const status = ContainerStatus(pod);
  const Json* const terminated = status == nullptr ? nullptr : Find(*status, {"state", "terminated"});
  if (terminated != nullptr) {
    const int64_t code = IntegerAt(*terminated, {"exitCode"}).value_or(-1);
    const std::string why = TextAt(*terminated, {"reason"}), said = TextAt(*terminated, {"message"});
    const bool plain = why.empty() || why == "Error" || why == "Completed";
    return PodEnd{code == 0, absl::StrCat("exit status ", code, plain ? "" : absl::StrCat(" (", why, ")"),
                                          said.empty() ? "" : ": ", said)};
  }
  if (phase == "Failed") return PodEnd{false, message.empty() ? "its Pod has failed" : message};
  if (phase == "Succeeded") return PodEnd{true, "exit status 0"};
  return std::nullopt;
}

}  // namespace aureole::kubernetes
