// Certificates of an authority of one's own, for worlds that have no other: what `aureole certificates` writes, in the
// layout of a Kubernetes TLS secret (server/transport/security.h).
#pragma once

#include <string>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>
#include <absl/time/time.h>

namespace aureole {

// Both PEM. The key (P-256) is PKCS #8 without a password.
struct KeyedCertificate {
  std::string certificate, key;
};

// In whole seconds; from before until.
struct Validity {
  absl::Time from, until;
};

// An authority that signs certificates. Internal when OpenSSL cannot; so for all of these.
absl::StatusOr<KeyedCertificate> MakeAuthority(const std::string& name, const Validity& validity);
// A certificate for both ends of a connection. A server's must have kServerName among its names; names that are IP
// addresses become such.
absl::StatusOr<KeyedCertificate> MakeCertificate(const KeyedCertificate& authority, const std::string& name,
                                                 const std::vector<std::string>& names, const Validity& validity);

// Writes tls.crt and tls.key into the directory, signed by ca.key and ca.crt there, which are made first when missing
// (valid for ten years). Servers of the directory serve the new certificate within a second or two. `names`: further
// DNS names or IP addresses of the servers. Keys are readable to their owner only. InvalidArgument when there is only
// one of ca.key and ca.crt; PermissionDenied when a file cannot be written.
absl::Status WriteCertificates(const std::string& directory, const std::vector<std::string>& names,
                               absl::Duration valid);

}  // namespace aureole
