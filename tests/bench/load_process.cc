#include "tests/bench/load_process.h"

#include <fcntl.h>
#include <signal.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <utility>

namespace aureole {

LoadProcess::LoadProcess(const std::string& program, const std::string& server, int clients,
                         const std::string& duration, const std::string& out) {
  const std::string n = std::to_string(clients);
  const char* arguments[] = {program.c_str(), "load",       "--server",       server.c_str(), "--clients",
                             n.c_str(),       "--duration", duration.c_str(), "--json",       nullptr};
  posix_spawn_file_actions_t files;
  posix_spawn_file_actions_init(&files);
  posix_spawn_file_actions_addopen(&files, 1, out.empty() ? "/dev/null" : out.c_str(), O_WRONLY | O_CREAT | O_TRUNC,
                                   0600);
  if (posix_spawn(&pid_, program.c_str(), &files, nullptr, const_cast<char**>(arguments), environ) != 0) pid_ = -1;
  posix_spawn_file_actions_destroy(&files);
}

LoadProcess::~LoadProcess() {
  Signal(SIGCONT);
  Signal(SIGINT);
  Wait();
}

void LoadProcess::Signal(int signal) const {
  if (pid_ > 0) kill(pid_, signal);
}

void LoadProcess::Wait() {
  if (pid_ > 0) waitpid(std::exchange(pid_, -1), nullptr, 0);
}

}  // namespace aureole
