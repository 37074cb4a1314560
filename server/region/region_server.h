// The region server process: joins the control plane, simulates the region that it is given, and leaves in order.
#pragma once

#include <chrono>
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
  // From SIGTERM to the end, for the region to leave the world that it is in, which then does not stop. 0: ends at
  // once.
  std::chrono::milliseconds leave_within{25000};
  SecurityOptions security;  // its log is the server's
};

// Blocks SIGTERM, SIGINT and SIGUSR1 in the calling thread and all that it starts: RunRegionServer takes them. Call it
// before the first thread.
void BlockSignals();

// Serves until the control plane says Stop, or will not have it any more, or SIGINT or SIGTERM. SIGTERM, in a world
// that runs: it asks the control plane to let its region leave, is not healthy any more, and goes on until it has left,
// that is refused, nobody answers for ten seconds, a second signal comes, or its time is over. Without a control plane
// it goes on, and joins again when one is there; it waits a minute for the first. SIGUSR1 cuts every link's connection
// once, for tests of the resumption. Returns the exit code: 0, or 1 when it could not listen, join or load the world,
// which is logged.
int RunRegionServer(const RegionServerOptions& options);

}  // namespace aureole
