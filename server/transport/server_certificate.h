// Whether a certificate makes its holder a server of this installation.
#pragma once

#include <string>

#include <absl/status/status.h>

namespace aureole {

// The DNS name in a server's certificate.
inline constexpr char kServerName[] = "server.aureole";

// `chain`: the certificate and those between it and one of `authorities`; both PEM. Unauthenticated when it does not
// lead there, is not valid now, or not for clients of TLS, or has no kServerName; the message says what is wrong with
// it.
absl::Status CheckServerCertificate(const std::string& chain, const std::string& authorities);

}  // namespace aureole
