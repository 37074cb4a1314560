#include "server/control/kubernetes/own_pod.h"

#include <set>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>

namespace aureole::kubernetes {
namespace {

bool Within(const std::string& path, const std::string& directory) {
  return !path.empty() && !directory.empty() && (path == directory || absl::StartsWith(path, directory + "/"));
}

Json Role(const Json& role) { return {{"metadata", {{"labels", {{kRoleLabel, role}}}}}}; }

}  // namespace

PodDefaults DefaultsOf(const Json& pod, const SecurityOptions& security) {
  PodDefaults out;
  out.flags = FlagsOf(security);
  const Json* const containers = Find(pod, {"spec", "containers"});
  if (containers == nullptr || !containers->is_array() || containers->empty()) return out;
  const Json& own = containers->front();
  out.image = TextAt(own, {"image"});
  out.pull_policy = TextAt(own, {"imagePullPolicy"});
  out.mounts = Json::array();
  out.volumes = Json::array();
  std::set<std::string> names;
  for (const Json& mount : own.value("volumeMounts", Json::array())) {
    const std::string path = TextAt(mount, {"mountPath"});
    if (!Within(security.tls, path) && !Within(security.tokens, path)) continue;
    out.mounts.push_back(mount);
    names.insert(TextAt(mount, {"name"}));
  }
  for (const Json& volume : pod["spec"].value("volumes", Json::array())) {
    if (names.contains(TextAt(volume, {"name"}))) out.volumes.push_back(volume);
  }
  return out;
}

absl::StatusOr<std::string> AddressOf(ApiClient* client, const std::string& service) {
  const absl::StatusOr<Json> object = client->Get({"", "v1", "services", client->space()}, service);
  if (!object.ok()) return object.status();
  const std::string ip = TextAt(*object, {"spec", "clusterIP"});
  const Json* const ports = Find(*object, {"spec", "ports"});
  int64_t port = 0;
  if (ports != nullptr && ports->is_array() && !ports->empty()) port = IntegerAt(ports->front(), {"port"}).value_or(0);
  if (ip.empty() || ip == "None" || port == 0) {
    return absl::FailedPreconditionError(
        absl::StrCat("--service: the Service ", service, " must have a clusterIP and a port"));
  }
  return absl::StrContains(ip, ':') ? absl::StrCat("[", ip, "]:", port) : absl::StrCat(ip, ":", port);
}

absl::Status LabelLeader(ApiClient* client, const std::string& pod) {
  const Resource pods{"", "v1", "pods", client->space()};
  const absl::StatusOr<ObjectList> leaders = client->List(
      pods, {.labels = absl::StrCat("app.kubernetes.io/name=", kControlName, ",", kRoleLabel, "=", kLeader)});
  if (!leaders.ok()) return leaders.status();
  bool labelled = false;
  for (const Json& other : leaders->items) {
    const std::string name = TextAt(other, {"metadata", "name"});
    if (name == pod) {
      labelled = true;
      continue;
    }
    absl::Status s = client->Patch(pods, name, {.body = Role(nullptr)}).status();
    if (!s.ok() && !absl::IsNotFound(s)) return s;
  }
  return labelled ? absl::OkStatus() : client->Patch(pods, pod, {.body = Role(kLeader)}).status();
}

}  // namespace aureole::kubernetes
