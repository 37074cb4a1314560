#include "server/control/local_allocator.h"

#include <gtest/gtest.h>
#include <signal.h>
#include <sys/stat.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <thread>

namespace aureole {
namespace {

namespace fs = std::filesystem;

class LocalAllocatorTest : public ::testing::Test {
 protected:
  LocalAllocatorTest() {
    std::string name = (fs::temp_directory_path() / "allocator-test-XXXXXX").string();
    directory_ = mkdtemp(name.data());
  }
  ~LocalAllocatorTest() override { fs::remove_all(directory_); }

  // A program that does what the shell text says.
  fs::path Program(const std::string& text) {
    const fs::path path = directory_ / "server";
    std::ofstream(path) << "#!/bin/sh\n" << text << "\n";
    chmod(path.c_str(), 0755);
    return path;
  }
  static std::vector<ServerExit> WaitForExits(LocalAllocator* allocator, size_t n) {
    std::vector<ServerExit> out;
    while (out.size() < n) {
      for (ServerExit& e : allocator->Poll()) out.push_back(std::move(e));
      std::this_thread::yield();
    }
    return out;
  }
  static bool Alive(pid_t pid) { return kill(pid, 0) == 0; }

  fs::path directory_;
};

TEST_F(LocalAllocatorTest, ServerIsToldWhereToJoin) {
  LocalAllocator allocator({Program("echo \"$@\""), directory_ / "logs"});
  ASSERT_TRUE(allocator.Start({4, 1, "secret", "127.0.0.1:99"}).ok());
  const auto exits = WaitForExits(&allocator, 1);
  EXPECT_EQ(exits[0].region, 4);
  EXPECT_TRUE(exits[0].clean);
  EXPECT_EQ(TailOfFile(directory_ / "logs/region-4.log", 1), "--control 127.0.0.1:99 --token secret --data " +
                                                                 (directory_ / "logs/region-4").string() +
                                                                 " --exit-with-parent");
}

TEST_F(LocalAllocatorTest, BadExitIsDescribedWithTheTailOfTheLog) {
  LocalAllocator allocator({Program("seq 1 50 >&2; exit 3"), directory_ / "logs"});
  ASSERT_TRUE(allocator.Start({0, 1, "t", "c"}).ok());
  const auto exits = WaitForExits(&allocator, 1);
  EXPECT_FALSE(exits[0].clean);
  EXPECT_EQ(exits[0].how, "exit status 3");
  EXPECT_EQ(exits[0].log_tail.substr(0, 5), "31\n32");
  EXPECT_EQ(exits[0].log_tail.substr(exits[0].log_tail.size() - 2), "50");
  EXPECT_TRUE(fs::exists(exits[0].log));
}

TEST_F(LocalAllocatorTest, SignalIsNamed) {
  LocalAllocator allocator({Program("kill -SEGV $$"), directory_ / "logs"});
  ASSERT_TRUE(allocator.Start({0, 1, "t", "c"}).ok());
  EXPECT_EQ(WaitForExits(&allocator, 1)[0].how, "killed by signal 11 (Segmentation fault)");
}

TEST_F(LocalAllocatorTest, KillEndsServersAndTheirChildrenEvenWhenStopped) {
  LocalAllocator allocator({Program("trap '' TERM INT\nsleep 1000 &\necho $! >&2\nwait"), directory_ / "logs"});
  ASSERT_TRUE(allocator.Start({0, 1, "t", "c"}).ok());
  const pid_t server = allocator.pids()[0];
  std::string child;
  while ((child = TailOfFile(directory_ / "logs/region-0.log", 1)).empty()) std::this_thread::yield();
  kill(server, SIGSTOP);
  allocator.Kill();
  EXPECT_EQ(allocator.running(), 0);
  EXPECT_FALSE(Alive(server));
  const fs::path status = fs::path("/proc") / child / "stat";  // a zombie until its new parent has waited for it
  for (std::string state = "R"; fs::exists(status) && state != "Z";) {
    std::ifstream in(status);
    std::string pid, name;
    in >> pid >> name >> state;
  }
}

TEST_F(LocalAllocatorTest, ServerIsInAGroupOfItsOwn) {
  LocalAllocator allocator({Program("exec sleep 1000"), directory_ / "logs"});
  ASSERT_TRUE(allocator.Start({0, 1, "t", "c"}).ok());
  const pid_t server = allocator.pids()[0];
  EXPECT_EQ(getpgid(server), server);
  EXPECT_NE(getpgid(server), getpgrp());
}

TEST_F(LocalAllocatorTest, KernelEndsServersWhenTheParentIsKilled) {
  const fs::path program = Program("echo ready >&2; exec sleep 1000");
  int pipe_ends[2];
  ASSERT_EQ(pipe(pipe_ends), 0);
  const pid_t parent = fork();
  if (parent == 0) {
    LocalAllocator allocator({program, directory_ / "logs"});
    if (!allocator.Start({0, 1, "t", "c"}).ok()) _exit(1);
    while (TailOfFile(allocator.LogFile(0), 1) != "ready") std::this_thread::yield();
    const pid_t server = allocator.pids()[0];
    if (write(pipe_ends[1], &server, sizeof server) != sizeof server) _exit(1);
    for (;;) pause();
  }
  pid_t server = 0;
  ASSERT_EQ(read(pipe_ends[0], &server, sizeof server), static_cast<ssize_t>(sizeof server));
  ASSERT_TRUE(Alive(server));
  kill(parent, SIGKILL);
  const std::string stat = "/proc/" + std::to_string(server) + "/stat";
  for (std::string state = "R"; fs::exists(stat) && state != "Z";) {
    std::ifstream in(stat);
    std::string pid, name;
    in >> pid >> name >> state;
  }
  close(pipe_ends[0]);
  close(pipe_ends[1]);
}

TEST_F(LocalAllocatorTest, MissingProgramIsSaidAndStartsNothing) {
  LocalAllocator allocator({directory_ / "nothing", ""});
  const absl::Status s = allocator.Start({0, 1, "t", "c"});
  EXPECT_TRUE(absl::IsNotFound(s)) << s;
  EXPECT_NE(s.message().find("nothing: No such file"), std::string::npos) << s;
  EXPECT_EQ(allocator.running(), 0);
}

TEST_F(LocalAllocatorTest, TemporaryLogsGoUnlessAServerEndedBadly) {
  fs::path kept, gone;
  {
    LocalAllocator good({Program("exit 0"), ""});
    ASSERT_TRUE(good.Start({0, 1, "t", "c"}).ok());
    gone = good.LogFile(0).parent_path();
    WaitForExits(&good, 1);
  }
  {
    LocalAllocator bad({Program("exit 1"), ""});
    ASSERT_TRUE(bad.Start({0, 1, "t", "c"}).ok());
    kept = bad.LogFile(0).parent_path();
    WaitForExits(&bad, 1);
  }
  EXPECT_FALSE(fs::exists(gone));
  EXPECT_TRUE(fs::exists(kept));
  fs::remove_all(kept);
}

}  // namespace
}  // namespace aureole
