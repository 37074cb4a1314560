// The browser viewer's gateway (client/viewer), as a process that ends with this one.
#pragma once

#include <sys/types.h>

#include <memory>
#include <string>

#include <absl/status/statusor.h>

namespace aureole {

class ViewerProcess {
 public:
  // Runs `directory`/gateway.js for the world of this server. Unavailable when it cannot be started.
  static absl::StatusOr<std::unique_ptr<ViewerProcess>> Start(const std::string& directory, const std::string& server);
  // Ends it.
  ~ViewerProcess();

  // What it has said since: "viewer: http://..." once, or why it cannot go on. Never waits.
  std::string TakeLines();

 private:
  ViewerProcess(pid_t pid, int in, int out) : pid_(pid), in_(in), out_(out) {}

  const pid_t pid_;
  const int in_, out_;  // its stdin, which it ends with, and its stdout and stderr
};

}  // namespace aureole
