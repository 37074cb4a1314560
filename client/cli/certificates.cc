#include "client/cli/certificates.h"

#include <iostream>

#include "client/cli/exit_codes.h"
#include "server/control/certificates.h"

namespace aureole {

CLI::App* AddCertificates(CLI::App& app, CertificatesOptions* o) {
  CLI::App* c = app.add_subcommand("certificates", "Make the certificates of a world's servers, or new ones");
  c->add_option("directory", o->directory, "Where they go; an authority that is there is used again")
      ->required()
      ->type_name("DIR");
  c->add_option("--host", o->hosts, "Further DNS names and addresses of the servers, for clients that look at them")
      ->type_name("NAME");
  c->add_option("--days", o->days, "How long the servers' certificate is valid")
      ->capture_default_str()
      ->check(CLI::Range(1, 3650));
  c->footer(
      std::string(
          "Examples:\n"
          "  aureole certificates certificates\n"
          "  aureole up tests/worlds/demo.json --tls certificates\n"
          "  aureole watch --server 127.0.0.1:40001 --tls-ca certificates/ca.crt\n\n"
          "Servers need ca.crt, tls.crt and tls.key, clients only ca.crt, and ca.key signs: keep it to yourself.\n"
          "Run it again before the days are over: servers serve the new certificate within two seconds.\n") +
      kExitCodesHelp);
  return c;
}

int RunCertificates(const CertificatesOptions& o) {
  const absl::Status s = WriteCertificates(o.directory, o.hosts, absl::Hours(24) * o.days);
  if (s.ok()) return kExitOk;
  std::cerr << s.message() << '\n';
  return kExitBadInput;
}

}  // namespace aureole
