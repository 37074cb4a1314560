// Starts and watches the servers of a world's regions. LocalAllocator runs them as processes of this machine,
// PodAllocator as Pods of a cluster, tests as threads.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/core/types.h"

namespace aureole {

struct ServerStart {
  RegionId region = kNoRegion;
  uint64_t incarnation = 1;  // grows with every server of the region
  std::string token;         // what the server says in its Hello
  std::string control;       // where it says it, host:port
  std::string listen = {};   // where the last one listened: clients look for it there; empty: anywhere
};

struct ServerExit {
  RegionId region = kNoRegion;
  uint64_t incarnation = 1;
  bool clean = false;    // exit status 0
  std::string how;       // "exit status 3", "killed by signal 9 (Killed)"
  std::string log;       // where all that it wrote is kept; empty when nowhere
  std::string log_tail;  // the last lines of it, may be empty
};

// One thread at a time: the one that made it.
class Allocator {
 public:
  // Leaves no server behind, unless they were released.
  virtual ~Allocator() = default;

  // Servers that an earlier control plane of this world has started and that may still run: they count as started here.
  // Once, before the first Start.
  virtual absl::StatusOr<std::vector<ServerStart>> Adopt() { return std::vector<ServerStart>(); }
  // From here on the servers go on by themselves, for the next control plane to adopt; nothing else is called.
  virtual void Release() {}

  // Returns once the server is started, not once it has joined. NotFound or Internal say why it could not.
  virtual absl::Status Start(const ServerStart& start) = 0;
  // Servers that ended since the last call. Call it several times a second.
  virtual std::vector<ServerExit> Poll() = 0;
  virtual int running() const = 0;
  // Ends one server at once, whatever it does; it is told of by Poll. Nothing when there is none.
  virtual void End(RegionId region, uint64_t incarnation) = 0;
  // Ends every server at once, without a chance to say goodbye, and waits until all are gone.
  virtual void Kill() = 0;
};

}  // namespace aureole
