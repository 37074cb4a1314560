// Clients push, spawn and remove bodies through real region servers: each input acts once, wherever its body is and
// whom they ask.
#include <gtest/gtest.h>

#include <grpcpp/grpcpp.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include <absl/strings/str_cat.h>

#include "aureole/v1/simulation.grpc.pb.h"
#include "client/cli/exit_codes.h"
#include "client/cli/recording.h"
#include "client/cli/replay.h"
#include "client/src/replica_decoder.h"
#include "tests/e2e/running_world.h"

namespace aureole {
namespace {

constexpr int kBodies = 24;
constexpr double kPush = 0.125;  // N s on 1 kg: sums are exact

// Weightless; every body flies in a lane of its own, half of them over every border.
v1::WorldSpec Lanes() {
  v1::WorldSpec spec;
  spec.set_name("lanes");
  spec.mutable_gravity();
  for (double edge : {-10, 0, 10}) spec.mutable_layout()->mutable_columns()->add_edges(edge);
  for (int i = 0; i < kBodies; ++i) {
    v1::Body* b = spec.add_bodies();
    b->set_id(static_cast<uint64_t>(i + 1));
    b->mutable_shape()->mutable_sphere()->set_radius(0.3);
    b->set_mass(1);
    b->mutable_position()->set_x(-20 + 40.0 * i / kBodies);
    b->mutable_position()->set_z(4 * i);
    b->mutable_velocity()->set_x(i % 2 == 0 ? 0 : i % 4 == 1 ? 4 : -4);
    b->mutable_velocity()->set_z(5);
  }
  return spec;
}

double StartVelocity(uint64_t body) {
  const uint64_t i = body - 1;
  return i % 2 == 0 ? 0 : i % 4 == 1 ? 4 : -4;
}

v1::Impulse Push(uint64_t sequence, uint64_t body) {
  v1::Impulse out;
  out.set_sequence(sequence);
  out.set_body(body);
  out.mutable_impulse()->set_x(kPush);
  return out;
}

class Client {
 public:
  explicit Client(const std::string& endpoint)
      : stub_(v1::Simulation::NewStub(grpc::CreateChannel(endpoint, grpc::InsecureChannelCredentials()))) {}

  // Sends the impulses in batches of 16; `cut`: goes away without waiting.
  grpc::Status Send(uint64_t id, const std::vector<v1::Impulse>& impulses, v1::ImpulseSummary* summary, bool cut) {
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(30));
    const auto stream = stub_->ApplyImpulses(&context, summary);
    for (size_t i = 0; i < impulses.size(); i += 16) {
      v1::ImpulseBatch batch;
      batch.set_client(i == 0 ? id : 0);
      for (size_t j = i; j < std::min(impulses.size(), i + 16); ++j) *batch.add_impulse() = impulses[j];
      if (!stream->Write(batch)) break;
    }
    if (cut) {
      context.TryCancel();
    } else {
      stream->WritesDone();
    }
    return stream->Finish();
  }

  grpc::Status Spawn(const v1::SpawnBodiesRequest& request, v1::SpawnBodiesResponse* response) {
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(30));
    return stub_->SpawnBodies(&context, request, response);
  }
  grpc::Status Remove(const v1::RemoveBodiesRequest& request, v1::RemoveBodiesResponse* response) {
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(30));
    v1::RemoveBodiesResponse ignored;
    return stub_->RemoveBodies(&context, request, response != nullptr ? response : &ignored);
  }

  int64_t Tick() {
    grpc::ClientContext context;
    v1::GetWorldResponse world;
    EXPECT_TRUE(stub_->GetWorld(&context, {}, &world).ok());
    return world.tick();
  }

  // Velocities along x of the bodies that this region owns.
  void AddVelocities(std::map<uint64_t, double>* out) {
    grpc::ClientContext context;
    v1::StreamReplicasRequest request;
    request.set_rate(1000);
    request.set_precision(v1::EXACT);
    const auto stream = stub_->StreamReplicas(&context, request);
    v1::ReplicaFrame frame;
    EXPECT_TRUE(stream->Read(&frame));
    client::ReplicaDecoder decoder(v1::EXACT, false);
    std::string error;
    EXPECT_TRUE(decoder.Apply(frame, &error)) << error;
    decoder.ForEach([&](uint64_t id) { (*out)[id] = decoder.Get(id).velocity[0]; });
    context.TryCancel();
    stream->Finish();
  }

 private:
  std::unique_ptr<v1::Simulation::Stub> stub_;
};

using Play = std::function<void(const std::vector<std::string>& endpoints)>;

void RunLanes(const Play& play) { PlayIn(Lanes(), 4, play); }

void ExpectRefused(const grpc::Status& status, v1::Reason reason, const std::string& field) {
  EXPECT_EQ(status.error_code(), grpc::StatusCode::INVALID_ARGUMENT) << field;
  v1::ErrorStatus details;
  v1::ErrorDetail detail;
  ASSERT_TRUE(details.ParseFromString(status.error_details())) << field;
  ASSERT_TRUE(details.details_size() == 1 && details.details(0).UnpackTo(&detail)) << field;
  EXPECT_EQ(detail.field(), field) << status.error_message();
  EXPECT_EQ(detail.reason(), reason) << status.error_message();
  EXPECT_FALSE(detail.remedy().empty());
  EXPECT_NE(status.error_message().find(field), std::string::npos);
}

TEST(Inputs, EachActsOnceWhereverItsBodyIsAndWhoeverIsAsked) {
  RunLanes([](const std::vector<std::string>& endpoints) {
    std::vector<v1::Impulse> impulses;
    std::map<uint64_t, double> expected;
    for (uint64_t body = 1; body <= kBodies; ++body) expected[body] = StartVelocity(body);
    for (uint64_t n = 1; n <= 480; ++n) {
      const uint64_t body = 1 + n * 7 % kBodies;
      impulses.push_back(Push(n, body));
      expected[body] += kPush;
    }
    v1::ImpulseSummary summary;
    // A client that loses its connection again and again, goes to the next server and says all from the start.
    for (size_t n = 0; n < 8; ++n) {
      const std::vector<v1::Impulse> some(impulses.begin(), impulses.begin() + static_cast<int>(60 * n + 30));
      Client(endpoints[n % 4]).Send(77, some, &summary, true);
    }
    summary.Clear();
    const grpc::Status s = Client(endpoints[1]).Send(77, impulses, &summary, false);
    ASSERT_TRUE(s.ok()) << s.error_message();
    EXPECT_EQ(summary.applied(), 480);
    EXPECT_EQ(summary.bodies(), 480);
    EXPECT_EQ(summary.rejected_size(), 0);
    EXPECT_GT(summary.last_tick(), 5);

    std::map<uint64_t, double> velocities;
    for (int attempt = 0; attempt < 100 && velocities.size() < kBodies; ++attempt) {  // some are between two servers
      for (const std::string& endpoint : endpoints) Client(endpoint).AddVelocities(&velocities);
    }
    EXPECT_EQ(velocities, expected);
  });
}

// 100,000 pushes in bursts at bodies that change servers, over a connection that is cut 50 times, while the servers'
// links are cut too: each acts once, and the recording of it all is, bit for bit, what one server computes.
TEST(Inputs, HundredThousandActOnceEachAndReplayTheSame) {
  constexpr int kCuts = 50, kPerCut = 2000;
  v1::WorldSpec world = Lanes();
  world.mutable_client_limits()->set_rate(1e6);
  const std::filesystem::path file =
      std::filesystem::path(testing::TempDir()) / absl::StrCat("pushes-", getpid(), ".mcap");
  PlayRun(world, 4, [&](const RunStatus& status) {
    std::vector<std::string> endpoints;
    for (const RegionStatus& r : status.regions) endpoints.push_back(r.endpoint);
    const pid_t recorder = fork();
    if (recorder == 0) {
      execl(AUREOLE_PROGRAM, "aureole", "record", "--server", endpoints[0].c_str(), "--out", file.c_str(), "--rate",
            "0", "--hash-every", "10", nullptr);
      _exit(127);
    }
    // It begins half a second from when it asks.
    const int64_t begun = Client(endpoints[0]).Tick() + 150;
    while (Client(endpoints[0]).Tick() < begun) std::this_thread::sleep_for(std::chrono::milliseconds(20));
    std::map<uint64_t, double> expected;
    for (uint64_t body = 1; body <= kBodies; ++body) expected[body] = StartVelocity(body);
    int64_t applied = 0;
    for (int cut = 0; cut < kCuts; ++cut) {
      std::vector<v1::Impulse> burst;
      for (int i = 0; i < kPerCut; ++i) {
        const uint64_t n = static_cast<uint64_t>(cut) * kPerCut + static_cast<uint64_t>(i) + 1;
        const uint64_t body = 1 + n * 7 % kBodies;
        const double push = n / kBodies % 2 == 0 ? kPush : -kPush;  // so that nothing flies off
        burst.push_back(Push(n, body));
        burst.back().mutable_impulse()->set_x(push);
        expected[body] += push;
      }
      v1::ImpulseSummary summary;
      const std::vector<v1::Impulse> some(burst.begin(), burst.begin() + 37 * (cut + 1));
      Client(endpoints[static_cast<size_t>(cut) % 4]).Send(77, some, &summary, true);
      if (cut % 5 == 4) {
        for (const RegionStatus& r : status.regions) kill(static_cast<pid_t>(r.pid), SIGUSR1);
      }
      summary.Clear();
      const grpc::Status s = Client(endpoints[static_cast<size_t>(cut + 1) % 4]).Send(77, burst, &summary, false);
      ASSERT_TRUE(s.ok()) << s.error_message();
      ASSERT_EQ(summary.rejected_size(), 0) << summary.ShortDebugString();
      applied += summary.applied();
    }
    EXPECT_EQ(applied, kCuts * kPerCut);
    std::map<uint64_t, double> velocities;
    for (int attempt = 0; attempt < 100 && velocities.size() < kBodies; ++attempt) {
      for (const std::string& endpoint : endpoints) Client(endpoint).AddVelocities(&velocities);
    }
    EXPECT_EQ(velocities, expected);
    kill(recorder, SIGINT);
    int exit = -1;
    ASSERT_EQ(waitpid(recorder, &exit, 0), recorder);
    EXPECT_EQ(exit, 0);
  });
  const absl::StatusOr<RecordedRun> recorded = ReadRecording(file.string());
  ASSERT_TRUE(recorded.ok()) << recorded.status();
  EXPECT_TRUE(recorded->whole);
  EXPECT_EQ(recorded->inputs.size(), size_t{kCuts} * kPerCut);
  EXPECT_GT(recorded->hashes.size(), 10u);
  EXPECT_EQ(RunReplay({.file = file.string(), .verify = true}), kExitOk);
  std::filesystem::remove(file);
}

TEST(Inputs, WhatIsNowhereOrTooMuchIsRejectedAloneWithTheReason) {
  v1::WorldSpec world = Lanes();
  world.mutable_client_limits()->set_impulse(100);
  world.mutable_client_limits()->set_rate(50);
  PlayIn(world, 4, [](const std::vector<std::string>& endpoints) {
    Client client(endpoints[2]);
    std::vector<v1::Impulse> impulses{Push(1, 999), Push(2, 3), Push(3, 3)};
    impulses[2].mutable_impulse()->set_y(100);
    for (uint64_t n = 4; n < 60; ++n) impulses.push_back(Push(n, 3));
    v1::ImpulseSummary summary;
    ASSERT_TRUE(client.Send(5, impulses, &summary, false).ok());
    std::map<v1::Reason, std::pair<int64_t, uint64_t>> rejected;
    for (const v1::Rejected& r : summary.rejected()) rejected[r.reason()] = {r.count(), r.first_sequence()};
    EXPECT_EQ(rejected[v1::NO_SUCH_BODY], (std::pair<int64_t, uint64_t>(1, 1)));
    EXPECT_EQ(rejected[v1::TOO_STRONG], (std::pair<int64_t, uint64_t>(1, 3)));
    EXPECT_GE(rejected[v1::RATE_LIMIT].first, 1);
    EXPECT_GT(rejected[v1::RATE_LIMIT].second, 50u) << "the first 50 are allowed at once";
    EXPECT_EQ(summary.applied() + rejected[v1::RATE_LIMIT].first + 2, 59);
  });
}

// What has acted must not be told as rejected: not where it was sent, and not at a server that only heard of it.
TEST(Inputs, RepetitionsAreNotChargedAgainstTheRateOfNewOnes) {
  v1::WorldSpec world = Lanes();
  world.mutable_client_limits()->set_rate(20);
  PlayIn(world, 4, [](const std::vector<std::string>& endpoints) {
    std::vector<v1::Impulse> pushes;
    for (uint64_t n = 1; n <= 20; ++n) pushes.push_back(Push(n, 1 + n % kBodies));
    for (size_t server : {1, 1, 2}) {
      v1::ImpulseSummary summary;
      const grpc::Status s = Client(endpoints[server]).Send(77, pushes, &summary, false);
      ASSERT_TRUE(s.ok()) << s.error_message();
      EXPECT_EQ(summary.applied(), 20) << summary.ShortDebugString();
    }
    // More of them than that end the call; of none it is said that it was rejected.
    v1::ImpulseSummary summary;
    grpc::Status s;
    for (int repetition = 0; repetition < 50 && s.ok(); ++repetition) {
      s = Client(endpoints[2]).Send(77, pushes, &summary, false);
      EXPECT_TRUE(!s.ok() || summary.applied() == 20);
    }
    EXPECT_EQ(s.error_code(), grpc::StatusCode::RESOURCE_EXHAUSTED);
    // What is new beside a repetition is charged.
    v1::SpawnBodiesRequest spawn;
    spawn.set_client(77);
    spawn.set_sequence(20);
    v1::Body* body = spawn.add_bodies();
    body->mutable_shape()->mutable_sphere()->set_radius(0.2);
    body->mutable_position()->set_y(500);
    body->mutable_array()->set_y(20);
    body->mutable_array()->mutable_spacing()->set_y(1);
    v1::SpawnBodiesResponse response;
    for (int calls = 0; calls < 50; ++calls) {
      s = Client(endpoints[1]).Spawn(spawn, &response);
      if (!s.ok()) break;
      spawn.set_sequence(spawn.sequence() + 19);
    }
    EXPECT_EQ(s.error_code(), grpc::StatusCode::RESOURCE_EXHAUSTED);
  });
}

TEST(Inputs, SpawnedBodiesLiveWhereTheyAreUntilTheyAreRemoved) {
  RunLanes([](const std::vector<std::string>& endpoints) {
    Client client(endpoints[0]), other(endpoints[3]);
    v1::SpawnBodiesRequest request;
    request.set_client(8);
    request.set_sequence(1);
    for (double x : {-15.0, -0.3, 5.0}) {
      v1::Body* b = request.add_bodies();
      b->mutable_shape()->mutable_sphere()->set_radius(0.2);
      b->mutable_position()->set_x(x);
      b->mutable_position()->set_y(30);
    }
    request.mutable_bodies(2)->mutable_array()->set_y(3);
    request.mutable_bodies(2)->mutable_array()->mutable_spacing()->set_y(1);
    v1::SpawnBodiesResponse spawned, again;
    ASSERT_TRUE(client.Spawn(request, &spawned).ok());
    ASSERT_EQ(spawned.body_size(), 5);
    EXPECT_EQ(spawned.rejected_size(), 0);
    EXPECT_GT(spawned.tick(), 5);
    ASSERT_TRUE(other.Spawn(request, &again).ok());
    EXPECT_EQ(std::vector(again.body().begin(), again.body().end()),
              std::vector(spawned.body().begin(), spawned.body().end()))
        << "a repetition, at another server, spawns nothing";
    EXPECT_EQ(again.tick(), spawned.tick());

    // A force over all of them, but for one that is outside of the sphere.
    v1::Impulse blow;
    blow.set_sequence(6);
    blow.mutable_sphere()->mutable_centre()->set_y(31);
    blow.mutable_sphere()->set_radius(14);
    blow.mutable_force()->set_y(1);
    blow.mutable_duration()->set_nanos(48'000'000);
    v1::ImpulseSummary summary;
    ASSERT_TRUE(other.Send(8, {blow}, &summary, false).ok());
    EXPECT_EQ(summary.applied(), 1);
    EXPECT_EQ(summary.bodies(), 4);

    v1::RemoveBodiesRequest remove;
    remove.set_client(8);
    remove.set_sequence(7);
    *remove.mutable_body() = spawned.body();
    remove.add_body(12345);
    v1::RemoveBodiesResponse removed;
    for (Client* c : {&client, &other}) {
      removed.Clear();
      ASSERT_TRUE(c->Remove(remove, &removed).ok());
      EXPECT_EQ(removed.removed(), 5);
      ASSERT_EQ(removed.rejected_size(), 1);
      EXPECT_EQ(removed.rejected(0).reason(), v1::NO_SUCH_BODY);
      EXPECT_EQ(removed.rejected(0).first_sequence(), 12u);
    }
  });
}

TEST(Inputs, WhatCannotBeIsRefusedWithItsFieldAndReason) {
  RunLanes([](const std::vector<std::string>& endpoints) {
    Client client(endpoints[2]);
    v1::ImpulseSummary summary;
    const auto refused = [&](v1::Reason reason, const std::string& field, uint64_t id, auto change) {
      std::vector<v1::Impulse> impulses{Push(10, 3), Push(11, 3)};
      change(&impulses[1]);
      ExpectRefused(client.Send(id, impulses, &summary, false), reason, "batch[0]." + field);
    };
    refused(v1::MISSING, "client", 0, [](v1::Impulse*) {});
    refused(v1::MISSING, "impulse[1].sequence", 6, [](v1::Impulse* i) { i->set_sequence(0); });
    refused(v1::MISSING, "impulse[1].body", 6, [](v1::Impulse* i) { i->set_body(0); });
    refused(v1::MISSING, "impulse[1].impulse", 6, [](v1::Impulse* i) { i->clear_impulse(); });
    refused(v1::BAD_VALUE, "impulse[1].impulse.y", 6, [](v1::Impulse* i) { i->mutable_impulse()->set_y(NAN); });
    refused(v1::CONFLICT, "impulse[1].sphere", 6, [](v1::Impulse* i) { i->mutable_sphere()->set_radius(1); });
    refused(v1::CONFLICT, "impulse[1].force", 6, [](v1::Impulse* i) { i->mutable_force(); });
    refused(v1::MISSING, "impulse[1].duration", 6, [](v1::Impulse* i) {
      i->clear_impulse();
      i->mutable_force()->set_x(1);
    });

    v1::SpawnBodiesRequest spawn;
    v1::SpawnBodiesResponse spawned;
    spawn.set_client(9);
    spawn.set_sequence(1);
    spawn.add_bodies()->mutable_shape()->mutable_sphere()->set_radius(-1);
    ExpectRefused(client.Spawn(spawn, &spawned), v1::BAD_VALUE, "bodies[0].shape.sphere.radius");
    spawn.mutable_bodies(0)->mutable_array()->set_x(2000);
    ExpectRefused(client.Spawn(spawn, &spawned), v1::TOO_MANY, "bodies");
    ExpectRefused(client.Remove({}, nullptr), v1::MISSING, "client");
  });
}

}  // namespace
}  // namespace aureole
