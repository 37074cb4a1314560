// Clients push bodies through real region servers: each impulse acts once, wherever its body is and whom they ask.
#include <gtest/gtest.h>

#include <grpcpp/grpcpp.h>

#include <cmath>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "aureole/v1/simulation.grpc.pb.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"

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
  out.mutable_linear()->set_x(kPush);
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

  // Velocities along x of the bodies that this region owns.
  void AddVelocities(std::map<uint64_t, double>* out) {
    grpc::ClientContext context;
    const auto stream = stub_->StreamReplicas(&context, {});
    v1::Replicas state;
    EXPECT_TRUE(stream->Read(&state));
    uint64_t id = 0;
    for (int i = 0; i < state.id_size(); ++i) {
      id += static_cast<uint64_t>(state.id(i));
      (*out)[id] = state.velocity(3 * i);
    }
    context.TryCancel();
    stream->Finish();
  }

 private:
  std::unique_ptr<v1::Simulation::Stub> stub_;
};

void RunLanes(const std::function<void(const std::vector<std::string>& endpoints)>& play) {
  RunOptions options;
  options.world = Lanes();
  options.regions = 4;
  LocalAllocator allocator({});
  RunResult result;
  bool played = false;
  const absl::Status end = RunWorld(
      options, allocator,
      [&](const RunStatus& status) {
        if (status.stage != Stage::kRunning || status.MinTick() < 5) return true;
        std::vector<std::string> endpoints;
        for (const RegionStatus& r : status.regions) endpoints.push_back(r.endpoint);
        play(endpoints);
        played = true;
        return false;
      },
      &result);
  EXPECT_EQ(end.code(), absl::StatusCode::kCancelled) << end;
  EXPECT_TRUE(played);
}

TEST(Impulses, EachActsOnceWhereverItsBodyIsAndWhoeverIsAsked) {
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
    EXPECT_EQ(summary.no_such_body(), 0);
    EXPECT_EQ(summary.forgotten(), 0);
    EXPECT_GT(summary.last_tick(), 5);

    std::map<uint64_t, double> velocities;
    for (int attempt = 0; attempt < 100 && velocities.size() < kBodies; ++attempt) {  // some are between two servers
      for (const std::string& endpoint : endpoints) Client(endpoint).AddVelocities(&velocities);
    }
    EXPECT_EQ(velocities, expected);
  });
}

TEST(Impulses, WhatCannotBeIsRefusedWithItsFieldAndWhatIsNowhereIsCounted) {
  RunLanes([](const std::vector<std::string>& endpoints) {
    Client client(endpoints[2]);
    v1::ImpulseSummary summary;
    ASSERT_TRUE(client.Send(5, {Push(1, 999), Push(2, 3)}, &summary, false).ok());
    EXPECT_EQ(summary.no_such_body(), 1);
    EXPECT_EQ(summary.applied(), 1);

    const auto refused = [&](const char* field, uint64_t id, auto change) {
      std::vector<v1::Impulse> impulses{Push(10, 3), Push(11, 3)};
      change(&impulses[1]);
      const grpc::Status s = client.Send(id, impulses, &summary, false);
      EXPECT_EQ(s.error_code(), grpc::StatusCode::INVALID_ARGUMENT) << field;
      EXPECT_NE(s.error_message().find(field), std::string::npos) << field << ": " << s.error_message();
    };
    refused("batch[0].client: ", 0, [](v1::Impulse*) {});
    refused("batch[0].impulse[1].sequence: ", 6, [](v1::Impulse* i) { i->set_sequence(0); });
    refused("batch[0].impulse[1].body: ", 6, [](v1::Impulse* i) { i->set_body(0); });
    refused("batch[0].impulse[1].linear: ", 6, [](v1::Impulse* i) { i->clear_linear(); });
    refused("batch[0].impulse[1].linear.y: ", 6, [](v1::Impulse* i) { i->mutable_linear()->set_y(NAN); });
    refused("batch[0].impulse[1].angular.z: ", 6, [](v1::Impulse* i) { i->mutable_angular()->set_z(-1e10); });
    refused("batch[0].impulse[1].linear.x: ", 6, [](v1::Impulse* i) { i->mutable_linear()->set_x(HUGE_VAL); });
  });
}

}  // namespace
}  // namespace aureole
