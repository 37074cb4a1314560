#include "server/control/kubernetes/cluster_access.h"

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <sstream>

#include <absl/strings/ascii.h>
#include <absl/strings/escaping.h>
#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_split.h>
#include <absl/strings/strip.h>

namespace aureole::kubernetes {
namespace {

absl::Status Wrong(const std::string& file, const std::string& field, const std::string& what) {
  return absl::InvalidArgumentError(absl::StrCat(file, ": ", field, ": ", what));
}

// A line end within would begin another header.
bool IsToken(const std::string& text) {
  return !text.empty() && std::all_of(text.begin(), text.end(),
                                      [](char c) { return absl::ascii_isgraph(static_cast<unsigned char>(c)); });
}

absl::Status CheckPem(const std::string& pem, const std::string& file, const std::string& field) {
  if (absl::StrContains(pem, "-----BEGIN ")) return absl::OkStatus();
  return Wrong(file, field, "holds no PEM block (-----BEGIN ...)");
}

// yaml-cpp throws; nothing of it leaves this class.
class Kubeconfig {
 public:
  Kubeconfig(std::string path, const YAML::Node& root) : path_(std::move(path)), root_(root) {}

  absl::StatusOr<ClusterAccess> Access() {
    const std::string current = Text(root_, "current-context");
    if (current.empty()) return Wrong(path_, "current-context", "missing; name one of the contexts");
    absl::StatusOr<Entry> context = Named("contexts", "context", current, "current-context");
    if (!context.ok()) return context.status();
    absl::StatusOr<Entry> cluster =
        Named("clusters", "cluster", Text(context->node, "cluster"), context->field + ".cluster");
    if (!cluster.ok()) return cluster.status();
    ClusterAccess access;
    access.space = Text(context->node, "namespace");
    if (access.space.empty()) access.space = "default";
    if (absl::Status s = ReadCluster(*cluster, &access); !s.ok()) return s;
    const std::string user_name = Text(context->node, "user");
    if (user_name.empty()) return access;
    absl::StatusOr<Entry> user = Named("users", "user", user_name, context->field + ".user");
    if (!user.ok()) return user.status();
    if (absl::Status s = ReadUser(*user, &access); !s.ok()) return s;
    return access;
  }

 private:
  struct Entry {
    YAML::Node node;
    std::string field;  // "clusters[k].cluster"
  };

  static std::string Text(const YAML::Node& node, const char* key) {
    if (!node.IsMap()) return "";
    const YAML::Node value = node[key];
    return value && value.IsScalar() ? value.Scalar() : "";
  }

  absl::StatusOr<Entry> Named(const char* list, const char* kind, const std::string& name,
                              const std::string& wanted_by) const {
    if (name.empty()) return Wrong(path_, wanted_by, "missing");
    const YAML::Node all = root_[list];
    if (all && all.IsSequence()) {
      for (const YAML::Node& item : all) {
        if (Text(item, "name") != name) continue;
        Entry entry{item[kind], absl::StrCat(list, "[", name, "].", kind)};
        if (!entry.node || !entry.node.IsMap()) return Wrong(path_, entry.field, "missing");
        return entry;
      }
    }
    return Wrong(path_, wanted_by, absl::StrCat("'", name, "' is not among the ", list));
  }

  absl::Status RefuseAny(const Entry& entry, std::initializer_list<const char*> keys, const char* remedy) const {
    for (const char* key : keys) {
      const YAML::Node value = entry.node[key];
      if (!value || value.IsNull() || (value.IsScalar() && (value.Scalar().empty() || value.Scalar() == "false"))) {
        continue;
      }
      return Wrong(path_, absl::StrCat(entry.field, ".", key), absl::StrCat("not supported; ", remedy));
    }
    return absl::OkStatus();
  }

  // What is at `key`-data in base64, or else in the file that `key` names; empty when neither is there.
  absl::StatusOr<std::string> Pem(const Entry& entry, const std::string& key) const {
    const std::string data = Text(entry.node, (key + "-data").c_str());
    if (!data.empty()) {
      const std::string field = absl::StrCat(entry.field, ".", key, "-data");
      std::string pem;
      if (!absl::Base64Unescape(data, &pem)) return Wrong(path_, field, "not base64");
      if (absl::Status s = CheckPem(pem, path_, field); !s.ok()) return s;
      return pem;
    }
    const std::string file = Text(entry.node, key.c_str());
    if (file.empty()) return std::string();
    absl::StatusOr<std::string> pem = ReadCredential(Relative(file));
    const std::string field = absl::StrCat(entry.field, ".", key);
    if (!pem.ok()) {
      return absl::Status(pem.status().code(), absl::StrCat(path_, ": ", field, ": ", pem.status().message()));
    }
    if (absl::Status s = CheckPem(*pem, path_, field); !s.ok()) return s;
    return pem;
  }

  absl::Status ReadCluster(const Entry& entry, ClusterAccess* access) const {
    if (absl::Status s = RefuseAny(entry, {"insecure-skip-tls-verify", "proxy-url", "tls-server-name"},
                                   "give the server's own address and its CA");
        !s.ok()) {
      return s;
    }
    access->server = std::string(absl::StripSuffix(Text(entry.node, "server"), "/"));
    const std::string field = entry.field + ".server";
    if (access->server.empty()) return Wrong(path_, field, "missing");
    absl::StatusOr<std::string> ca = Pem(entry, "certificate-authority");
    if (!ca.ok()) return ca.status();
    access->ca = *std::move(ca);
    if (absl::StartsWith(access->server, "https://")) {
      if (!access->ca.empty()) return absl::OkStatus();
      return Wrong(path_, entry.field + ".certificate-authority",
                   "missing; the server is verified against it and nothing else");
    }
    // `kubectl proxy` and tests. A secret must not cross a network in the clear.
    for (const char* local : {"http://127.0.0.1:", "http://localhost:", "http://[::1]:"}) {
      if (absl::StartsWith(access->server, local)) return absl::OkStatus();
    }
    return Wrong(path_, field,
                 absl::StrCat("'", access->server, "' must begin with https:// (http:// is for this machine only)"));
  }

  absl::Status ReadUser(const Entry& entry, ClusterAccess* access) const {
    if (absl::Status s = RefuseAny(
            entry, {"exec", "auth-provider", "username", "password", "as", "as-uid", "as-groups", "as-user-extra"},
            "give a token, a tokenFile or a client certificate");
        !s.ok()) {
      return s;
    }
    absl::StatusOr<std::string> certificate = Pem(entry, "client-certificate");
    if (!certificate.ok()) return certificate.status();
    absl::StatusOr<std::string> key = Pem(entry, "client-key");
    if (!key.ok()) return key.status();
    if (certificate->empty() != key->empty()) {
      return Wrong(path_, absl::StrCat(entry.field, certificate->empty() ? ".client-certificate" : ".client-key"),
                   "missing; a certificate and its key go together");
    }
    access->client_certificate = *std::move(certificate);
    access->client_key = *std::move(key);
    access->token = Text(entry.node, "token");
    if (!access->token.empty() && !IsToken(access->token)) {
      return Wrong(path_, entry.field + ".token", "has characters that no token has");
    }
    const std::string token_file = Text(entry.node, "tokenFile");
    if (token_file.empty()) return absl::OkStatus();
    access->token_file = Relative(token_file);
    if (absl::StatusOr<std::string> token = ReadToken(access->token_file); !token.ok()) {
      return {token.status().code(), absl::StrCat(path_, ": ", entry.field, ".tokenFile: ", token.status().message())};
    }
    return absl::OkStatus();
  }

  std::string Relative(const std::string& file) const {
    return (std::filesystem::path(path_).parent_path() / file).string();  // `file` itself when it is absolute
  }

  const std::string path_;
  const YAML::Node root_;
};

std::string Environment(const char* name) {
  const char* const value = std::getenv(name);
  return value == nullptr ? "" : value;
}

}  // namespace

absl::StatusOr<std::string> ReadCredential(const std::string& path) {
  std::error_code error;
  if (std::filesystem::is_directory(path, error)) {
    return absl::NotFoundError(absl::StrCat(path, ": cannot be read: is a directory"));
  }
  errno = 0;
  std::ifstream in(path, std::ios::binary);
  std::ostringstream text;
  if (!in.is_open()) return absl::NotFoundError(absl::StrCat(path, ": cannot be read: ", std::strerror(errno)));
  text << in.rdbuf();
  if (in.bad() || text.str().empty()) return absl::NotFoundError(absl::StrCat(path, ": is empty"));
  return text.str();
}

absl::StatusOr<std::string> ReadToken(const std::string& path) {
  absl::StatusOr<std::string> text = ReadCredential(path);
  if (!text.ok()) return text;
  std::string token(absl::StripAsciiWhitespace(*text));
  if (!IsToken(token)) return absl::InvalidArgumentError(absl::StrCat(path, ": is not a token"));
  return token;
}

absl::StatusOr<ClusterAccess> ServiceAccountAccess(const std::string& host, const std::string& port,
                                                   const std::string& directory) {
  if (host.empty() || port.empty()) {
    return absl::InvalidArgumentError(absl::StrCat(host.empty() ? "KUBERNETES_SERVICE_HOST" : "KUBERNETES_SERVICE_PORT",
                                                   ": not set; this is not a pod, give a kubeconfig"));
  }
  ClusterAccess access;
  access.server = absl::StrContains(host, ':') ? absl::StrCat("https://[", host, "]:", port)
                                               : absl::StrCat("https://", host, ":", port);
  absl::StatusOr<std::string> ca = ReadCredential(directory + "/ca.crt");
  if (!ca.ok()) return ca.status();
  if (absl::Status s = CheckPem(*ca, directory + "/ca.crt", "certificate"); !s.ok()) return s;
  access.ca = *std::move(ca);
  access.token_file = directory + "/token";
  if (absl::StatusOr<std::string> token = ReadToken(access.token_file); !token.ok()) return token.status();
  absl::StatusOr<std::string> space = ReadCredential(directory + "/namespace");
  if (!space.ok()) return space.status();
  access.space = std::string(absl::StripAsciiWhitespace(*space));
  return access;
}

absl::StatusOr<ClusterAccess> KubeconfigAccess(const std::string& path) {
  absl::StatusOr<std::string> text = ReadCredential(path);
  if (!text.ok()) return text.status();
  try {
    const YAML::Node root = YAML::Load(*text);
    if (!root.IsMap()) return absl::InvalidArgumentError(absl::StrCat(path, ": is not a kubeconfig"));
    return Kubeconfig(path, root).Access();
  } catch (const YAML::Exception& e) {
    return absl::InvalidArgumentError(absl::StrCat(path, ": ", e.what()));
  }
}

absl::StatusOr<ClusterAccess> FindAccess(const std::string& path) {
  if (!path.empty()) return KubeconfigAccess(path);
  if (const std::string files = Environment("KUBECONFIG"); !files.empty()) {
    if (absl::StrContains(files, ':')) {
      return absl::InvalidArgumentError(absl::StrCat("KUBECONFIG: ", files, ": name one file; several are not merged"));
    }
    return KubeconfigAccess(files);
  }
  const std::string host = Environment("KUBERNETES_SERVICE_HOST");
  if (!host.empty()) return ServiceAccountAccess(host, Environment("KUBERNETES_SERVICE_PORT"));
  const std::string home = Environment("HOME") + "/.kube/config";
  if (std::filesystem::exists(home)) return KubeconfigAccess(home);
  return absl::NotFoundError(
      absl::StrCat("no Kubernetes to talk to: --kubeconfig not given, KUBECONFIG not set, this is not a pod, and ",
                   home, " is not there"));
}

}  // namespace aureole::kubernetes
