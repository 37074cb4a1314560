// Where the API server is and who we are there: from the service account of a pod, or from a kubeconfig.
#pragma once

#include <string>

#include <absl/status/statusor.h>

namespace aureole::kubernetes {

struct ClusterAccess {
  std::string server;                          // "https://10.96.0.1:443", without a slash at the end
  std::string ca;                              // PEM: the only roots that are trusted; empty only with http
  std::string client_certificate, client_key;  // PEM; both or neither
  std::string token;                           // does not change; of no meaning beside a token_file
  std::string token_file;                      // holds a token that changes (bearer_token.h)
  std::string space;                           // the namespace; "default" when nothing says otherwise
};

// In a pod: `host` and `port` are $KUBERNETES_SERVICE_HOST and $KUBERNETES_SERVICE_PORT; `directory` has ca.crt, token
// and namespace.
inline constexpr char kServiceAccount[] = "/var/run/secrets/kubernetes.io/serviceaccount";
absl::StatusOr<ClusterAccess> ServiceAccountAccess(const std::string& host, const std::string& port,
                                                   const std::string& directory = kServiceAccount);

// The current context of a kubeconfig. Files that it names are relative to its directory. What would be needed but is
// not supported (exec and auth-provider, passwords, impersonation, a proxy, no verification, another TLS server name)
// is refused, not ignored.
absl::StatusOr<ClusterAccess> KubeconfigAccess(const std::string& path);

// The kubeconfig `path` when given, else that of $KUBECONFIG, else the service account in a pod, else ~/.kube/config.
//
// Errors of all three begin with the file and, where there is one, the field:
// "/etc/kubeconfig: clusters[k].cluster.server: missing". NotFound: a file cannot be read, or there is none to try.
// InvalidArgument: what it says cannot be used.
absl::StatusOr<ClusterAccess> FindAccess(const std::string& path);

// The contents of a file; NotFound, beginning with its path.
absl::StatusOr<std::string> ReadCredential(const std::string& path);
// Likewise, without the white space around it; InvalidArgument when it cannot be the value of a header.
absl::StatusOr<std::string> ReadToken(const std::string& path);

}  // namespace aureole::kubernetes
