// A world whose servers have certificates and want tokens: it runs as any other, for those who may.
#include "tests/e2e/security_fixture.h"

#include <csignal>
#include <thread>

#include "aureole/client.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/world_file.h"

namespace aureole {
namespace {

using client::Client;

class SecuredWorld : public SecurityTest {
 protected:
  // Runs until the observer has said so, with a checkpoint every 20 ticks.
  void Run(const RunObserver& observe) {
    const absl::StatusOr<WorldFile> file = OpenWorldFile(AUREOLE_WORLDS "/bridge.json");
    ASSERT_TRUE(file.ok()) << file.status();
    RunOptions options;
    options.world = file->spec;
    options.regions = file->world.layout.size();
    options.checkpoint_every = 20;
    options.security.tls = (directory_ / "tls").string();
    options.security.tokens = TokenPath();
    LocalAllocator::Options servers;
    servers.flags = FlagsOf(options.security);
    LocalAllocator allocator(servers);
    RunResult result;
    const absl::Status end = RunWorld(options, allocator, observe, &result);
    EXPECT_EQ(end.code(), absl::StatusCode::kCancelled) << end;
  }
  // Calls `play` with the servers' endpoints once all have stepped a few ticks; then ends them.
  void Play(const std::function<void(const std::vector<std::string>&)>& play) {
    bool played = false;
    Run([&](const RunStatus& status) {
      if (status.stage != Stage::kRunning || status.MinTick() < 5) return true;
      std::vector<std::string> endpoints;
      for (const RegionStatus& r : status.regions) endpoints.push_back(r.endpoint);
      play(endpoints);
      played = true;
      return false;
    });
    EXPECT_TRUE(played);
  }
  client::Access Access(const std::string& token) const { return {authority_.certificate, token}; }

  const std::string tls_ = Certificates("tls");
};

TEST_F(SecuredWorld, RunsAndServesEachTokenWhatItMay) {
  const std::string watch = Token({"watch"}, "bridge"), push = Token({"watch", "push"}, "bridge");
  const std::string elsewhere = Token({"watch"}, "tower");
  Play([&](const std::vector<std::string>& endpoints) {
    std::unique_ptr<Client> watcher, pusher, none;
    EXPECT_EQ(Client::Connect(endpoints[0], &none, 5, Access("")).reason, "NO_TOKEN");
    EXPECT_EQ(Client::Connect(endpoints[0], &none, 5, Access(elsewhere)).reason, "WRONG_WORLD");
    EXPECT_FALSE(Client::Connect(endpoints[0], &none, 1, {"", watch}).ok());  // plain text
    ASSERT_TRUE(Client::Connect(endpoints[0], &watcher, 10, Access(watch)).ok());
    ASSERT_TRUE(watcher->Watch({}).ok());
    ASSERT_TRUE(watcher->WaitUntilComplete(20));  // of all servers
    std::vector<client::Body> bodies;
    watcher->Latest(&bodies);
    ASSERT_FALSE(bodies.empty());

    client::Push kick;
    kick.body = bodies[0].id;
    kick.linear = {0, 1, 0};
    watcher->Do(kick);
    client::PushCounts counts;
    EXPECT_TRUE(watcher->Flush(20, &counts).ok());
    ASSERT_EQ(counts.rejected, 1);
    EXPECT_EQ(counts.reasons[0].first, "NO_RIGHT");

    ASSERT_TRUE(Client::Connect(endpoints.back(), &pusher, 10, Access(push)).ok());
    pusher->Do(kick);
    EXPECT_TRUE(pusher->Flush(20, &counts).ok());
    EXPECT_EQ(counts.applied, 1);
    const client::Status removed = pusher->Remove({kick.body});
    EXPECT_EQ(removed.reason, "NO_RIGHT");
    EXPECT_EQ(removed.code, 7);
  });
}

TEST_F(SecuredWorld, ServerThatDiesIsReplacedAndFoundByItsPeers) {
  Token({"watch"}, "bridge");
  const auto until = std::chrono::steady_clock::now() + std::chrono::seconds(60);
  int64_t killed_pid = 0;
  Tick killed_at = 0;
  bool went_on = false;
  Run([&](const RunStatus& status) {
    if (std::chrono::steady_clock::now() > until) return false;
    if (status.stage != Stage::kRunning) return true;
    const RegionStatus& dialled = status.regions[1];
    if (killed_pid == 0 && status.MinTick() > 60) {
      killed_pid = dialled.pid;
      killed_at = status.MinTick();
      kill(static_cast<pid_t>(killed_pid), SIGKILL);
    }
    went_on = killed_pid != 0 && dialled.pid != killed_pid && status.MinTick() > killed_at + 100;
    return !went_on;
  });
  EXPECT_TRUE(went_on) << "killed at tick " << killed_at;
}

}  // namespace
}  // namespace aureole
