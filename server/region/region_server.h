// The region server process: joins the control plane, simulates the region that it is given, and leaves in order.
#pragma once

#include <string>

#include "server/transport/security.h"

namespace aureole {

struct RegionServerOptions {
  std::string control;                  // host:port of the control plane
  std::string token;                    // says which region this process was started for
  std::string listen = "127.0.0.1:0";   // for peers and clients
  std::string metrics = "127.0.0.1:0";  // Prometheus over HTTP; "off"
  std::string data;                     // directory for checkpoints; empty: none
  std::string world;                    // which of the control plane's worlds; empty: its only one
  SecurityOptions security;             // its log is the server's
};

// Blocks SIGTERM, SIGINT and SIGUSR1 in the calling thread and all that it starts: RunRegionServer takes them. Call it
// before the first thread.
void BlockSignals();

// Serves until the control plane says Stop, or will not have it any more, or SIGTERM or SIGINT. Without a control plane
// it goes on, and joins again when one is there; it waits a minute for the first. SIGUSR1 cuts every link's connection
// once, for tests of the resumption. Returns the exit code: 0, or 1 when it could not listen, join or load the world,
// which is logged.
int RunRegionServer(const RegionServerOptions& options);

}  // namespace aureole
