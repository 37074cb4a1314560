// Real region servers: faults of connections and processes change no bit, and what they serve beside the simulation.
#include <arpa/inet.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/socket.h>
#include <unistd.h>

#include <grpcpp/grpcpp.h>

#include <set>

#include "aureole/v1/simulation.grpc.pb.h"
#include "client/src/replica_decoder.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/transport/health_check.h"
#include "tests/e2e/exact_run.h"

namespace aureole {
namespace {

using std::chrono::steady_clock;

RunResult RunRegions(const RunOptions& options, const RunObserver& observe) {
  LocalAllocator allocator({});
  RunResult result;
  const absl::Status s = RunWorld(options, allocator, observe, &result);
  EXPECT_TRUE(s.ok()) << s;
  EXPECT_EQ(allocator.running(), 0);
  return result;
}

RunResult RunUndivided(RunOptions options) {
  options.undivided = options.no_real_time = true;
  options.regions = 1;
  return RunRegions(options, [](const RunStatus&) { return true; });
}

void ExpectSameHashes(const RunResult& a, const RunResult& b) {
  ASSERT_EQ(a.hashes.size(), b.hashes.size());
  for (size_t i = 0; i < a.hashes.size(); ++i) {
    EXPECT_EQ(a.hashes[i].tick, b.hashes[i].tick);
    EXPECT_EQ(a.hashes[i].hash, b.hashes[i].hash) << "tick " << a.hashes[i].tick;
    EXPECT_EQ(a.hashes[i].bodies, b.hashes[i].bodies) << "tick " << a.hashes[i].tick;
  }
}

TEST(RegionProcess, CuttingConnectionsAHundredTimesChangesNoBit) {
  const RunOptions options = OptionsFor("corner-storm.json", 700, 50);
  size_t cuts = 0;
  const RunResult split = RunRegions(options, [&](const RunStatus& status) {
    if (status.stage != Stage::kRunning || status.MinTick() < 10 || status.MaxTick() > 600) return true;
    // Each region cuts its links to all others.
    const RegionStatus& region = status.regions[cuts++ % status.regions.size()];
    EXPECT_EQ(kill(static_cast<pid_t>(region.pid), SIGUSR1), 0);
    return true;
  });
  int64_t reconnects = 0, transfers = 0;
  for (const RegionStatus& r : split.status.regions) {
    reconnects += r.report.reconnects();
    transfers += r.report.transfers();
    EXPECT_EQ(r.report.refused_frames(), 0);
  }
  EXPECT_GT(reconnects, 200) << "both ends of a link count";
  EXPECT_GT(transfers, 100);
  ExpectSameHashes(split, RunUndivided(options));
}

TEST(RegionProcess, StoppedForTwoSecondsMakesTheOthersWaitAndSaySo) {
  const RunOptions options = OptionsFor("demo.json", 250, 50);
  constexpr RegionId kStopped = 1;
  enum { kBefore, kStoppedNow, kAfter } phase = kBefore;
  steady_clock::time_point stopped_at;
  std::set<RegionId> waiting, waited_for;
  const RunResult split = RunRegions(options, [&](const RunStatus& status) {
    const pid_t pid = static_cast<pid_t>(status.regions[kStopped].pid);
    if (phase == kBefore && status.stage == Stage::kRunning && status.MinTick() > 50) {
      EXPECT_EQ(kill(pid, SIGSTOP), 0);
      stopped_at = steady_clock::now();
      phase = kStoppedNow;
    } else if (phase == kStoppedNow) {
      for (RegionId r = 0; r < static_cast<RegionId>(status.regions.size()); ++r) {
        for (RegionId missing : status.regions[r].report.waiting_for()) {
          waiting.insert(r);
          waited_for.insert(missing);
        }
      }
      if (steady_clock::now() - stopped_at >= std::chrono::seconds(2)) {
        EXPECT_EQ(kill(pid, SIGCONT), 0);
        phase = kAfter;
      }
    }
    return true;
  });
  EXPECT_EQ(phase, kAfter);
  EXPECT_EQ(waiting, (std::set<RegionId>{0, 2, 3}));
  // A region may wait for one that waits itself; only one is waited for and does not wait.
  std::erase_if(waited_for, [&waiting](RegionId r) { return waiting.contains(r); });
  EXPECT_EQ(waited_for, std::set<RegionId>{kStopped});
  ExpectSameHashes(split, RunUndivided(options));
}

// The body of GET /metrics.
std::string Scrape(const std::string& endpoint) {
  const size_t colon = endpoint.rfind(':');
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_port = htons(static_cast<uint16_t>(std::stoi(endpoint.substr(colon + 1))));
  inet_pton(AF_INET, endpoint.substr(0, colon).c_str(), &address.sin_addr);
  const int fd = socket(AF_INET, SOCK_STREAM, 0);
  std::string text;
  const std::string request = "GET /metrics HTTP/1.0\r\n\r\n";
  if (connect(fd, reinterpret_cast<const sockaddr*>(&address), sizeof address) == 0 &&
      write(fd, request.data(), request.size()) == static_cast<ssize_t>(request.size())) {
    char buffer[4096];
    for (ssize_t n; (n = read(fd, buffer, sizeof buffer)) > 0;) text.append(buffer, n);
  }
  close(fd);
  return text;
}

TEST(RegionProcess, ServesHealthMetricsAndReplicasWhileItTicks) {
  RunOptions options = OptionsFor("demo.json", 0, 50);
  bool looked = false;
  LocalAllocator allocator({});
  RunResult result;
  const absl::Status end = RunWorld(
      options, allocator,
      [&](const RunStatus& status) {
        if (status.stage != Stage::kRunning || status.MinTick() < 20) return true;
        looked = true;
        const RegionStatus& region = status.regions[2];
        EXPECT_TRUE(CheckHealth(region.endpoint).ok());

        const std::string metrics = Scrape(region.metrics_endpoint);
        for (const char* name :
             {"aureole_tick{region=\"2\",world=\"demo\"} ", "# TYPE aureole_frame_cpu_seconds histogram",
              "aureole_transfers_total{cause=\"boundary_traverse\"", "aureole_violations_total{"}) {
          EXPECT_NE(metrics.find(name), std::string::npos) << name << " in " << metrics;
        }

        const auto stub =
            v1::Simulation::NewStub(grpc::CreateChannel(region.endpoint, grpc::InsecureChannelCredentials()));
        grpc::ClientContext get;
        v1::GetWorldResponse world;
        EXPECT_TRUE(stub->GetWorld(&get, {}, &world).ok());
        EXPECT_EQ(world.name(), "demo");
        EXPECT_EQ(world.region(), 2);
        EXPECT_EQ(world.endpoints_size(), 4);
        EXPECT_EQ(world.layout_size(), 4);
        EXPECT_GE(world.tick(), 20);

        grpc::ClientContext watch;
        watch.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(20));
        v1::StreamReplicasRequest request;
        request.set_rate(50);
        const auto stream = stub->StreamReplicas(&watch, request);
        client::ReplicaDecoder decoder(v1::FINE, false);
        std::set<uint64_t> described;
        for (int n = 0; n < 5; ++n) {
          v1::ReplicaFrame frame;
          EXPECT_TRUE(stream->Read(&frame));
          EXPECT_EQ(frame.region(), 2);
          EXPECT_GT(frame.tick(), decoder.tick());
          std::string error;
          EXPECT_TRUE(decoder.Apply(frame, &error)) << error;
          for (const v1::BodyDescription& d : frame.described()) {
            EXPECT_NE(d.shape().kind_case(), v1::Shape::KIND_NOT_SET);
            EXPECT_GT(d.mass(), 0);
            uint64_t id = 0;
            for (uint64_t step : d.body()) described.insert(id += step);
          }
          EXPECT_GT(decoder.bodies(), 0u);
          decoder.ForEach([&](uint64_t id) { EXPECT_TRUE(described.contains(id)) << "no shape of body " << id; });
        }
        watch.TryCancel();
        stream->Finish();
        return false;
      },
      &result);
  EXPECT_EQ(end.code(), absl::StatusCode::kCancelled) << end;
  EXPECT_TRUE(looked);
  EXPECT_FALSE(CheckHealth(result.status.regions[2].endpoint).ok());
}

}  // namespace
}  // namespace aureole
