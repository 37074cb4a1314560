// aureole-control kubernetes: the control plane of all Worlds of a namespace. Several run, one leads.
#pragma once

#include <string>

#include "server/control/kubernetes/leader_election.h"
#include "server/transport/security.h"

namespace aureole::kubernetes {

inline constexpr char kControlService[] = "aureole-control";

struct ControlProcessOptions {
  std::string metrics = "off";            // Prometheus over HTTP, host:port
  std::string listen = "0.0.0.0:7100";    // where region servers join; health, too
  std::string space;                      // the namespace; empty: our own
  std::string service = kControlService;  // whose address region servers dial; empty: `address`
  std::string lease = kControlService;    // its name
  std::string pod;                        // our Pod's name; empty: this is no Pod
  std::string address;                    // our IP; without a service: where region servers dial
  ElectionTiming election = {};
  SecurityOptions security;  // of what listens here, and of the region servers
};

// Until SIGTERM or its like: then the worlds go on, and the next one leads at once. Returns the exit code: 0, or 1 when
// it could not start, which is logged. A leader whose lease is lost ends the process at once.
int RunControlProcess(const ControlProcessOptions& options);

// The command line after `aureole-control kubernetes`: `arguments` begins with the program's name. Returns the exit
// code, 2 for bad flags.
int KubernetesMain(int arguments, char** words);

}  // namespace aureole::kubernetes
