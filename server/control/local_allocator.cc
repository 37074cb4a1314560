#include "server/control/local_allocator.h"

#include <fcntl.h>
#include <linux/close_range.h>
#include <poll.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <iostream>
#include <system_error>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_join.h>
#include <absl/strings/str_split.h>

#include "server/control/write_file.h"

namespace aureole {
namespace {

constexpr int kTailLines = 20;
constexpr std::streamoff kTailBytes = 16 << 10;

std::filesystem::path OwnDirectory() {
  std::error_code error;
  return std::filesystem::read_symlink("/proc/self/exe", error).parent_path();
}

// Between fork and exec in a process with threads: only async-signal-safe calls, so everything is prepared before.
[[noreturn]] void RunChild(const char* executable, char* const* arguments, int log, int null, pid_t parent,
                           bool outlive) {
  if (outlive) {
    setsid();
  } else {
    setpgid(0, 0);
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    if (getppid() != parent) _exit(127);  // it died before the prctl
  }
  sigset_t none;
  sigemptyset(&none);
  sigprocmask(SIG_SETMASK, &none, nullptr);
  signal(SIGPIPE, SIG_DFL);
  dup2(null, STDIN_FILENO);
  dup2(log, STDOUT_FILENO);
  dup2(log, STDERR_FILENO);
  close_range(3, ~0U, CLOSE_RANGE_CLOEXEC);
  execv(executable, arguments);
  constexpr char kMessage[] = "the region server cannot be executed\n";
  [[maybe_unused]] const ssize_t written = write(STDERR_FILENO, kMessage, sizeof kMessage - 1);
  _exit(127);
}

}  // namespace

std::string TailOfFile(const std::filesystem::path& path, int lines) {
  std::ifstream in(path, std::ios::binary);
  if (!in) return "";
  in.seekg(0, std::ios::end);
  const std::streamoff size = in.tellg();
  in.seekg(std::max<std::streamoff>(0, size - kTailBytes));
  std::string text(std::istreambuf_iterator<char>(in), {});
  while (!text.empty() && text.back() == '\n') text.pop_back();
  const std::vector<std::string> all = absl::StrSplit(text, '\n');
  const size_t first = all.size() > static_cast<size_t>(lines) ? all.size() - lines : 0;
  return absl::StrJoin(all.begin() + static_cast<std::ptrdiff_t>(first), all.end(), "\n");
}

LocalAllocator::LocalAllocator(Options options) : options_(std::move(options)) {
  if (options_.executable.empty()) options_.executable = OwnDirectory() / "aureole-region";
}

LocalAllocator::~LocalAllocator() {
  Kill();
  std::error_code ignored;
  if (temporary_ && !bad_exit_) std::filesystem::remove_all(options_.log_directory, ignored);
}

std::filesystem::path LocalAllocator::LogFile(RegionId region) const {
  return options_.log_directory / absl::StrCat("region-", region, ".log");
}

std::filesystem::path LocalAllocator::DataOf(RegionId region) const {
  const std::filesystem::path& data =
      options_.data_directory.empty() ? options_.log_directory : options_.data_directory;
  return data / absl::StrCat("region-", region);
}

std::filesystem::path LocalAllocator::ServerFile(RegionId region) const { return DataOf(region).string() + ".server"; }

absl::Status LocalAllocator::WriteServerFile(const ServerStart& start, pid_t pid) const {
  const std::filesystem::path path = ServerFile(start.region);
  std::error_code error;
  std::filesystem::create_directories(path.parent_path(), error);
  return WriteFile(path, absl::StrCat(start.region, " ", start.incarnation, " ", pid, " ", start.token, "\n"), 0600);
}

absl::StatusOr<std::vector<ServerStart>> LocalAllocator::Adopt() {
  std::vector<ServerStart> out;
  if (!options_.outlive) return out;
  if (absl::Status s = Prepare(); !s.ok()) return s;
  std::error_code error;
  for (const auto& entry : std::filesystem::directory_iterator(options_.data_directory, error)) {
    if (entry.path().extension() != ".server") continue;
    std::ifstream in(entry.path());
    ServerStart server;
    Child child;
    if (!(in >> server.region >> server.incarnation >> child.pid >> server.token)) continue;
    // The number may be another process's by now; what it was started with tells.
    child.pid_fd = static_cast<int>(syscall(SYS_pidfd_open, child.pid, 0));
    if (child.pid_fd < 0) continue;
    std::ifstream words(absl::StrCat("/proc/", child.pid, "/cmdline"), std::ios::binary);
    const std::string started_with(std::istreambuf_iterator<char>(words), {});
    if (!absl::StrContains(started_with, server.token)) {
      close(child.pid_fd);
      continue;
    }
    child.region = server.region;
    child.incarnation = server.incarnation;
    children_.push_back(child);
    const auto size = std::filesystem::file_size(LogFile(server.region), error);
    logs_.push_back({server.region, error ? 0 : static_cast<std::streamoff>(size)});
    out.push_back(std::move(server));
  }
  return out;
}

void LocalAllocator::Release() {
  for (const Child& child : children_) {
    if (child.pid_fd >= 0) close(child.pid_fd);
  }
  children_.clear();
}

std::vector<pid_t> LocalAllocator::pids() const {
  std::vector<pid_t> out;
  for (const Child& child : children_) out.push_back(child.pid);
  return out;
}

absl::Status LocalAllocator::Prepare() {
  if (access(options_.executable.c_str(), X_OK) != 0) {
    return absl::NotFoundError(absl::StrCat("no region server at ", options_.executable.string(), ": ",
                                            std::strerror(errno), "; build the target aureole-region"));
  }
  if (!logs_.empty()) return absl::OkStatus();
  std::error_code error;
  if (!options_.log_directory.empty()) {
    std::filesystem::create_directories(options_.log_directory, error);
    if (!error) return absl::OkStatus();
    return absl::InternalError(
        absl::StrCat("cannot make the log directory ", options_.log_directory.string(), ": ", error.message()));
  }
  const std::filesystem::path parent = std::filesystem::temp_directory_path(error);
  std::string name = ((error ? "/tmp" : parent) / "aureole-XXXXXX").string();
  if (mkdtemp(name.data()) == nullptr) {
    return absl::InternalError(absl::StrCat("cannot make a temporary directory ", name, ": ", std::strerror(errno)));
  }
  options_.log_directory = name;
  temporary_ = true;
  return absl::OkStatus();
}

absl::Status LocalAllocator::Start(const ServerStart& start) {
  if (absl::Status s = Prepare(); !s.ok()) return s;
  const std::string executable = options_.executable.string();
  const std::string path = LogFile(start.region).string();
  const bool first = std::none_of(logs_.begin(), logs_.end(), [&](const Log& l) { return l.region == start.region; });
  const int log = open(path.c_str(), O_WRONLY | O_CREAT | (first ? O_TRUNC : 0) | O_APPEND | O_CLOEXEC, 0644);
  if (log < 0) return absl::InternalError(absl::StrCat("cannot write ", path, ": ", std::strerror(errno)));
  const int null = open("/dev/null", O_RDONLY | O_CLOEXEC);

  std::vector<std::string> words = {
      executable, "--control", start.control, "--token", start.token, "--data", DataOf(start.region).string()};
  if (!options_.outlive) words.emplace_back("--exit-with-parent");
  words.insert(words.end(), options_.flags.begin(), options_.flags.end());
  if (!start.listen.empty()) words.insert(words.end(), {"--listen", start.listen});
  std::vector<char*> arguments;
  for (std::string& word : words) arguments.push_back(word.data());
  arguments.push_back(nullptr);

  const pid_t parent = getpid();
  const pid_t pid = fork();
  if (pid == 0) RunChild(executable.c_str(), arguments.data(), log, null, parent, options_.outlive);
  const int fork_error = errno;
  close(log);
  close(null);
  if (pid < 0) {
    return absl::InternalError(
        absl::StrCat("cannot start the server of region ", start.region, ": ", std::strerror(fork_error)));
  }
  setpgid(pid, pid);  // in both processes, so that Kill never comes too early for the group
  children_.push_back({start.region, start.incarnation, pid});
  if (first) logs_.push_back({start.region, 0});
  // One that nobody can find again is not let in again: its token is forgotten with this process.
  return options_.outlive ? WriteServerFile(start, pid) : absl::OkStatus();
}

std::vector<ServerExit> LocalAllocator::Poll() {
  std::vector<ServerExit> exits;
  for (size_t i = 0; i < children_.size();) {
    Child& child = children_[i];
    int status = 0;
    pollfd ended{child.pid_fd, POLLIN, 0};
    const bool gone = child.pid_fd >= 0 ? poll(&ended, 1, 0) > 0 : waitpid(child.pid, &status, WNOHANG) != 0;
    if (!gone) {
      ++i;
      continue;
    }
    exits.push_back(Describe(child, status));
    if (child.pid_fd >= 0) close(child.pid_fd);
    children_.erase(children_.begin() + static_cast<std::ptrdiff_t>(i));
  }
  RepeatLogs();
  return exits;
}

ServerExit LocalAllocator::Describe(const Child& child, int wait_status) {
  ServerExit exit;
  exit.region = child.region;
  exit.incarnation = child.incarnation;
  if (child.pid_fd >= 0) {
    exit.clean = true;  // only its parent could tell
    exit.how = "ended; how is not known, since an earlier control plane had started it";
  } else if (WIFSIGNALED(wait_status)) {
    const int number = WTERMSIG(wait_status);
    exit.how = absl::StrCat("killed by signal ", number, " (", strsignal(number), ")");
  } else {
    exit.clean = WEXITSTATUS(wait_status) == 0;
    exit.how = absl::StrCat("exit status ", WEXITSTATUS(wait_status));
  }
  if (!exit.clean) {
    bad_exit_ = true;
    exit.log = LogFile(child.region).string();
    exit.log_tail = TailOfFile(exit.log, kTailLines);
  }
  return exit;
}

void LocalAllocator::End(RegionId region, uint64_t incarnation) {
  for (const Child& child : children_) {
    if (child.region == region && child.incarnation == incarnation) kill(-child.pid, SIGKILL);
  }
}

void LocalAllocator::Kill() {
  for (const Child& child : children_) kill(-child.pid, SIGKILL);
  for (const Child& child : children_) Await(child);
  Release();
  RepeatLogs();
}

// Until it is gone.
void LocalAllocator::Await(const Child& child) {
  pollfd ended{child.pid_fd, POLLIN, 0};
  while ((child.pid_fd >= 0 ? poll(&ended, 1, -1) : waitpid(child.pid, nullptr, 0)) < 0 && errno == EINTR) {
  }
}

void LocalAllocator::RepeatLogs() {
  if (!options_.verbose) return;
  for (Log& log : logs_) {
    std::ifstream in(LogFile(log.region), std::ios::binary);
    in.seekg(log.shown);
    std::string line;
    while (std::getline(in, line) && !in.eof()) {  // a last line without its end waits for the rest
      std::cerr << "[region " << log.region << "] " << line << '\n';
      log.shown += static_cast<std::streamoff>(line.size()) + 1;
    }
  }
}

}  // namespace aureole
