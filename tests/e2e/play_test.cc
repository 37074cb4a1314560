// Play: replicas, pushes and acknowledgements over one stream of a real region server.
#include <gtest/gtest.h>

#include <grpcpp/grpcpp.h>

#include <chrono>
#include <cmath>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "aureole/v1/simulation.grpc.pb.h"
#include "client/src/replica_decoder.h"
#include "tests/e2e/running_world.h"

namespace aureole {
namespace {

using namespace std::chrono_literals;

// One weightless region, whose bodies turn and drift.
v1::WorldSpec Drift(int bodies) {
  v1::WorldSpec spec;
  spec.set_name("drift");
  spec.mutable_gravity();
  for (int i = 0; i < bodies; ++i) {
    v1::Body* b = spec.add_bodies();
    b->set_id(static_cast<uint64_t>(i + 1));
    b->mutable_shape()->mutable_sphere()->set_radius(0.3);
    b->set_mass(1);
    b->mutable_position()->set_x(5 * (i % 50));
    b->mutable_position()->set_z(5 * (i / 50));
    b->mutable_velocity()->set_y(1);
  }
  return spec;
}

void RunDrift(int bodies, const std::function<void(const std::string& endpoint)>& play) {
  PlayIn(Drift(bodies), 1, [&](const std::vector<std::string>& endpoints) { play(endpoints[0]); });
}

class Player {
 public:
  explicit Player(const std::string& endpoint)
      : stub_(v1::Simulation::NewStub(grpc::CreateChannel(endpoint, grpc::InsecureChannelCredentials()))) {
    context_.set_deadline(std::chrono::system_clock::now() + 60s);
    stream_ = stub_->Play(&context_);
  }
  ~Player() {
    context_.TryCancel();
    if (!finished_) stream_->Finish();
  }

  bool Send(const v1::PlayRequest& request) { return stream_->Write(request); }
  bool Read(v1::PlayResponse* response) { return stream_->Read(response); }
  void WritesDone() { stream_->WritesDone(); }
  grpc::Status Finish() {
    finished_ = true;
    return stream_->Finish();
  }

 private:
  grpc::ClientContext context_;
  std::unique_ptr<v1::Simulation::Stub> stub_;
  std::unique_ptr<grpc::ClientReaderWriter<v1::PlayRequest, v1::PlayResponse>> stream_;
  bool finished_ = false;
};

v1::PlayRequest WatchBox(double max_x) {
  v1::PlayRequest request;
  request.mutable_watch()->set_rate(1000);
  v1::Box* box = request.mutable_watch()->mutable_view()->mutable_box();
  box->mutable_min()->set_x(-1);
  box->mutable_max()->set_x(max_x);
  box->mutable_max()->set_z(30);
  return request;
}

v1::Impulse Push(uint64_t sequence, uint64_t body) {
  v1::Impulse out;
  out.set_sequence(sequence);
  out.set_body(body);
  out.mutable_velocity_change()->set_y(10);
  return out;
}

TEST(Play, FramesFollowTheViewAndPushesHaveTheirOutcomes) {
  RunDrift(200, [](const std::string& endpoint) {
    Player player(endpoint);
    ASSERT_TRUE(player.Send(WatchBox(30)));
    v1::PlayRequest pushes;
    pushes.mutable_inputs()->set_client(4);
    *pushes.mutable_inputs()->add_impulse() = Push(1, 1);
    *pushes.mutable_inputs()->add_impulse() = Push(2, 777);
    *pushes.mutable_inputs()->add_impulse() = Push(3, 2);
    pushes.mutable_inputs()->mutable_impulse(2)->mutable_velocity_change()->set_x(2000);
    ASSERT_TRUE(player.Send(pushes));
    std::map<uint64_t, v1::Reason> outcomes;
    client::ReplicaDecoder decoder(v1::FINE, false);
    std::string error;
    bool wide = false;
    double top = 0;
    for (int n = 0; n < 500 && (outcomes.size() < 3 || top < 3 || decoder.bodies() < 150); ++n) {
      v1::PlayResponse response;
      ASSERT_TRUE(player.Read(&response));
      const v1::InputOutcomes& o = response.outcomes();
      for (int i = 0; i < o.sequence_size(); ++i) {
        EXPECT_TRUE(outcomes.emplace(o.sequence(i), o.reason(i)).second) << "one outcome each";
        EXPECT_EQ(o.bodies(i), o.sequence(i) == 1 ? 1 : 0);
        EXPECT_EQ(o.tick(i) > 0, o.sequence(i) != 3);
      }
      if (!response.has_frame()) continue;
      ASSERT_TRUE(decoder.Apply(response.frame(), &error)) << error;
      if (decoder.Contains(1)) top = std::max(top, decoder.Get(1).position[1]);
      if (!wide) {
        EXPECT_EQ(decoder.bodies(), 28u) << "4 rows of 7: the cell of x < 32";
        wide = true;
        ASSERT_TRUE(player.Send(WatchBox(300)));
      }
    }
    EXPECT_EQ(decoder.bodies(), 200u);
    EXPECT_GT(top, 3) << "the push is seen";
    EXPECT_EQ(outcomes[1], v1::REASON_UNSPECIFIED);
    EXPECT_EQ(outcomes[2], v1::NO_SUCH_BODY);
    EXPECT_EQ(outcomes[3], v1::TOO_STRONG);
  });
}

TEST(Play, ClientThatStopsAcknowledgingIsSentNoMoreUntilItGoesOn) {
  RunDrift(20, [](const std::string& endpoint) {
    Player player(endpoint);
    v1::PlayRequest request = WatchBox(300);
    ASSERT_TRUE(player.Send(request));
    v1::PlayResponse response;
    ASSERT_TRUE(player.Read(&response));
    request.Clear();
    request.set_acknowledged_tick(response.frame().tick());
    ASSERT_TRUE(player.Send(request));
    std::this_thread::sleep_for(1s);  // 60 ticks, of which it is told few
    int64_t last = response.frame().tick();
    int frames = 0;
    int64_t jump = 0;
    // What was on the way, then, once that is acknowledged, the newest.
    while (jump < 20 && frames < 100) {
      ASSERT_TRUE(player.Read(&response));
      ++frames;
      jump = response.frame().tick() - std::exchange(last, response.frame().tick());
      request.set_acknowledged_tick(last);
      ASSERT_TRUE(player.Send(request));
    }
    EXPECT_GE(jump, 20) << "old frames were not kept for it";
    EXPECT_LE(frames, 30);
  });
}

TEST(Play, EndsWhenTheClientHasSaidAllAndHeardAll) {
  RunDrift(20, [](const std::string& endpoint) {
    Player player(endpoint);
    v1::PlayRequest request;
    request.mutable_inputs()->set_client(4);
    for (uint64_t n = 1; n <= 1000; ++n) *request.mutable_inputs()->add_impulse() = Push(n, 1 + n % 20);
    ASSERT_TRUE(player.Send(request));
    player.WritesDone();
    int outcomes = 0;
    v1::PlayResponse response;
    while (player.Read(&response)) outcomes += response.outcomes().sequence_size();
    EXPECT_EQ(outcomes, 1000);
    EXPECT_TRUE(player.Finish().ok());
  });
}

TEST(Play, WhatIsWrongEndsTheStreamWithItsField) {
  RunDrift(20, [](const std::string& endpoint) {
    const auto refused = [&](const std::string& what, const std::vector<v1::PlayRequest>& requests) {
      Player player(endpoint);
      for (const v1::PlayRequest& r : requests) player.Send(r);
      v1::PlayResponse response;
      while (player.Read(&response)) {
      }
      const grpc::Status s = player.Finish();
      EXPECT_EQ(s.error_code(), grpc::StatusCode::INVALID_ARGUMENT) << what;
      EXPECT_NE(s.error_message().find(what), std::string::npos) << s.error_message();
    };
    v1::PlayRequest bad = WatchBox(10);
    bad.mutable_watch()->set_rate(-1);
    refused("BAD_VALUE request[0].watch.rate: ", {bad});
    v1::PlayRequest other = WatchBox(10);
    other.mutable_watch()->set_velocities(true);
    refused("CONFLICT request[1].watch: ", {WatchBox(10), other});
    v1::PlayRequest push;
    *push.mutable_inputs()->add_impulse() = Push(1, 1);
    refused("MISSING request[0].inputs.client: ", {push});
  });
}

}  // namespace
}  // namespace aureole
