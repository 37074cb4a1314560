// aureole certificates: an authority of one's own, and a certificate for the servers.
#pragma once

#include <string>
#include <vector>

#include <CLI/CLI.hpp>

namespace aureole {

struct CertificatesOptions {
  std::string directory;
  std::vector<std::string> hosts;
  int days = 90;
};

CLI::App* AddCertificates(CLI::App& app, CertificatesOptions* options);
int RunCertificates(const CertificatesOptions& options);

}  // namespace aureole
