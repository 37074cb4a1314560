#include "client/cli/viewer_process.h"

#include <fcntl.h>
#include <signal.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

#include <absl/strings/str_cat.h>

namespace aureole {

absl::StatusOr<std::unique_ptr<ViewerProcess>> ViewerProcess::Start(const std::string& directory,
                                                                    const std::string& server) {
  const std::string gateway = directory + "/gateway.js";
  if (access(gateway.c_str(), R_OK) != 0) {
    return absl::UnavailableError(absl::StrCat("--viewer: there is no ", gateway));
  }
  int in[2], out[2];
  if (pipe2(in, O_CLOEXEC) != 0) return absl::UnavailableError(absl::StrCat("pipe: ", std::strerror(errno)));
  if (pipe2(out, O_CLOEXEC) != 0) {
    close(in[0]);
    close(in[1]);
    return absl::UnavailableError(absl::StrCat("pipe: ", std::strerror(errno)));
  }
  const char* arguments[] = {"node", gateway.c_str(), "--server", server.c_str(), "--exit-with-stdin", nullptr};
  posix_spawn_file_actions_t files;
  posix_spawn_file_actions_init(&files);
  posix_spawn_file_actions_adddup2(&files, in[0], 0);
  posix_spawn_file_actions_adddup2(&files, out[1], 1);
  posix_spawn_file_actions_adddup2(&files, out[1], 2);
  pid_t pid = -1;
  const int error = posix_spawnp(&pid, "node", &files, nullptr, const_cast<char**>(arguments), environ);
  posix_spawn_file_actions_destroy(&files);
  close(in[0]);
  close(out[1]);
  if (error != 0) {
    close(in[1]);
    close(out[0]);
    return absl::UnavailableError(absl::StrCat("--viewer: node cannot be run: ", std::strerror(error)));
  }
  fcntl(out[0], F_SETFL, O_NONBLOCK);
  return std::unique_ptr<ViewerProcess>(new ViewerProcess(pid, in[1], out[0]));
}

ViewerProcess::~ViewerProcess() {
  close(in_);
  kill(pid_, SIGTERM);
  // It has nothing to save.
  bool runs = true;
  for (int i = 0; i < 200 && (runs = waitpid(pid_, nullptr, WNOHANG) == 0); ++i) usleep(10'000);
  if (runs) {
    kill(pid_, SIGKILL);
    waitpid(pid_, nullptr, 0);
  }
  close(out_);
}

std::string ViewerProcess::TakeLines() {
  std::string out;
  char buffer[4096];
  for (ssize_t n = 0; (n = read(out_, buffer, sizeof(buffer))) > 0;) out.append(buffer, static_cast<size_t>(n));
  return out;
}

}  // namespace aureole
