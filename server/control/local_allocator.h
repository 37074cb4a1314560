// Region servers as processes of this machine.
#pragma once

#include <sys/types.h>

#include <filesystem>
#include <string>
#include <vector>

#include "server/control/allocator.h"

namespace aureole {

// Every server is a child in a process group of its own, so that Ctrl-C reaches only the parent, which then stops them
// in order. Unless they outlive this process, the kernel kills them when the thread that started them ends, however it
// ends: keep that thread alive.
class LocalAllocator final : public Allocator {
 public:
  struct Options {
    // The region server; empty: `aureole-region` in the directory of this program.
    std::filesystem::path executable;
    // Where servers log, one file per region; made when missing and kept. Empty: a temporary directory, which is
    // removed at the end unless a server ended badly.
    std::filesystem::path log_directory;
    // Repeats what the servers log on stderr, each line after its region.
    bool verbose = false;
    // Where servers keep checkpoints, a directory for each region; made when missing and kept. Empty: beside the logs.
    std::filesystem::path data_directory = {};
    // Further flags of every server, such as --tls DIR.
    std::vector<std::string> flags = {};
    // Servers go on when this process dies; the next allocator with this data directory adopts them. Needs both
    // directories. A file region-N.server beside the data of region N says which process it is, and its token.
    bool outlive = false;
  };
  explicit LocalAllocator(Options options);
  ~LocalAllocator() override;
  LocalAllocator(const LocalAllocator&) = delete;
  LocalAllocator& operator=(const LocalAllocator&) = delete;

  absl::StatusOr<std::vector<ServerStart>> Adopt() override;
  void Release() override;
  absl::Status Start(const ServerStart& start) override;
  std::vector<ServerExit> Poll() override;
  int running() const override { return static_cast<int>(children_.size()); }
  void End(RegionId region, uint64_t incarnation) override;
  void Kill() override;

  std::filesystem::path LogFile(RegionId region) const;
  // For tests and messages.
  std::vector<pid_t> pids() const;

 private:
  struct Child {
    RegionId region = kNoRegion;
    uint64_t incarnation = 1;
    pid_t pid = 0;
    int pid_fd = -1;  // of one that is not our child
  };
  struct Log {
    RegionId region = kNoRegion;
    std::streamoff shown = 0;  // bytes already repeated on stderr
  };
  absl::Status Prepare();
  std::filesystem::path DataOf(RegionId region) const;
  std::filesystem::path ServerFile(RegionId region) const;
  absl::Status WriteServerFile(const ServerStart& start, pid_t pid) const;
  static void Await(const Child& child);
  void RepeatLogs();
  ServerExit Describe(const Child& child, int wait_status);

  Options options_;
  bool temporary_ = false;  // options_.log_directory is ours to remove
  bool bad_exit_ = false;
  std::vector<Child> children_;  // running
  std::vector<Log> logs_;
};

// The last `lines` lines of a text file, without the final newline; empty when it cannot be read.
std::string TailOfFile(const std::filesystem::path& path, int lines);

}  // namespace aureole
