// Whatever a client gets wrong, in any call, is refused with the right code, reason and field, and changes no bit.
#include <gtest/gtest.h>

#include <google/protobuf/text_format.h>
#include <grpcpp/grpcpp.h>

#include <chrono>
#include <memory>
#include <string>
#include <vector>

#include <absl/strings/str_cat.h>

#include "aureole/v1/error.pb.h"
#include "aureole/v1/recording.grpc.pb.h"
#include "aureole/v1/simulation.grpc.pb.h"
#include "tests/e2e/running_world.h"

namespace aureole {
namespace {

struct Case {
  const char* rpc;
  std::string request;  // in protobuf's text format; of a stream: its first message
  v1::Reason reason;
  const char* field;
  grpc::StatusCode code = grpc::StatusCode::INVALID_ARGUMENT;
};

// A push and a body with one thing changed.
std::string Batch(const std::string& push) { return absl::StrCat("client: 5 impulse { sequence: 1 ", push, " }"); }
std::string Spawn(const std::string& body) { return absl::StrCat("client: 5 sequence: 1 bodies { ", body, " }"); }
std::string Ball(const std::string& more) { return Spawn("shape { sphere { radius: 1 } } " + more); }
std::string Ray(const std::string& ray) { return absl::StrCat("rays { ", ray, " }"); }
std::string Times(int n, const std::string& what) {
  std::string out;
  for (int i = 0; i < n; ++i) absl::StrAppend(&out, what, " ");
  return out;
}

std::vector<Case> Cases() {
  using enum v1::Reason;
  constexpr auto kMissing = MISSING;
  constexpr auto kBad = BAD_VALUE;
  constexpr auto kConflict = CONFLICT;
  constexpr auto kTooMany = TOO_MANY;
  std::vector<Case> out{
      // ApplyImpulses
      {"ApplyImpulses", "impulse { sequence: 1 body: 1 impulse { x: 1 } }", kMissing, "batch[0].client"},
      {"ApplyImpulses", "client: 5 impulse { body: 1 impulse { x: 1 } }", kMissing, "batch[0].impulse[0].sequence"},
      {"ApplyImpulses", Batch("impulse { x: 1 }"), kMissing, "batch[0].impulse[0].body"},
      {"ApplyImpulses", Batch("body: 1"), kMissing, "batch[0].impulse[0].impulse"},
      {"ApplyImpulses", Batch("body: 1 impulse { x: nan }"), kBad, "batch[0].impulse[0].impulse.x"},
      {"ApplyImpulses", Batch("body: 1 impulse { y: inf }"), kBad, "batch[0].impulse[0].impulse.y"},
      {"ApplyImpulses", Batch("body: 1 impulse { z: -1e13 }"), kBad, "batch[0].impulse[0].impulse.z"},
      {"ApplyImpulses", Batch("body: 1 torque_impulse { x: nan }"), kBad, "batch[0].impulse[0].torque_impulse.x"},
      {"ApplyImpulses", Batch("body: 1 velocity_change { x: 2e4 }"), kBad, "batch[0].impulse[0].velocity_change.x"},
      {"ApplyImpulses", Batch("body: 1 velocity_change { x: -inf }"), kBad, "batch[0].impulse[0].velocity_change.x"},
      {"ApplyImpulses", Batch("body: 1 spin_change { y: 1e4 }"), kBad, "batch[0].impulse[0].spin_change.y"},
      {"ApplyImpulses", Batch("body: 1 impulse { x: 1 } velocity_change { x: 1 }"), kConflict,
       "batch[0].impulse[0].velocity_change"},
      {"ApplyImpulses", Batch("body: 1 impulse { x: 1 } force { x: 1 } duration { seconds: 1 }"), kConflict,
       "batch[0].impulse[0].force"},
      {"ApplyImpulses", Batch("body: 1 force { x: 1 }"), kMissing, "batch[0].impulse[0].duration"},
      {"ApplyImpulses", Batch("body: 1 force { x: nan } duration { seconds: 1 }"), kBad, "batch[0].impulse[0].force.x"},
      {"ApplyImpulses", Batch("body: 1 torque { x: inf } duration { seconds: 1 }"), kBad,
       "batch[0].impulse[0].torque.x"},
      {"ApplyImpulses", Batch("body: 1 force { x: 1 } duration { seconds: 61 }"), kBad, "batch[0].impulse[0].duration"},
      {"ApplyImpulses", Batch("body: 1 force { x: 1 } duration { seconds: -1 }"), kBad, "batch[0].impulse[0].duration"},
      {"ApplyImpulses", Batch("body: 1 force { x: 1 } duration { }"), kBad, "batch[0].impulse[0].duration"},
      {"ApplyImpulses", Batch("body: 1 impulse { x: 1 } duration { seconds: 1 }"), kConflict,
       "batch[0].impulse[0].duration"},
      {"ApplyImpulses", Batch("body: 1 impulse { x: 1 } at_point { x: nan }"), kBad, "batch[0].impulse[0].at_point.x"},
      {"ApplyImpulses", Batch("body: 1 impulse { x: 1 } at_body_point { z: 1e7 }"), kBad,
       "batch[0].impulse[0].at_body_point.z"},
      {"ApplyImpulses", Batch("body: 1 impulse { x: 1 } at_point { } at_body_point { }"), kConflict,
       "batch[0].impulse[0].at_body_point"},
      {"ApplyImpulses", Batch("body: 1 velocity_change { x: 1 } at_point { }"), kConflict,
       "batch[0].impulse[0].at_point"},
      {"ApplyImpulses", Batch("body: 1 sphere { radius: 1 } impulse { x: 1 }"), kConflict,
       "batch[0].impulse[0].sphere"},
      {"ApplyImpulses", Batch("sphere { } impulse { x: 1 }"), kBad, "batch[0].impulse[0].sphere.radius"},
      {"ApplyImpulses", Batch("sphere { radius: -1 } impulse { x: 1 }"), kBad, "batch[0].impulse[0].sphere.radius"},
      {"ApplyImpulses", Batch("sphere { radius: nan } impulse { x: 1 }"), kBad, "batch[0].impulse[0].sphere.radius"},
      {"ApplyImpulses", Batch("sphere { radius: 2e5 } impulse { x: 1 }"), kBad, "batch[0].impulse[0].sphere.radius"},
      {"ApplyImpulses", Batch("sphere { radius: 1 outward: nan }"), kBad, "batch[0].impulse[0].sphere.outward"},
      {"ApplyImpulses", Batch("sphere { radius: 1 centre { x: inf } } impulse { x: 1 }"), kBad,
       "batch[0].impulse[0].sphere.centre.x"},
      {"ApplyImpulses", "client: 5 " + Times(1025, "impulse { sequence: 1 body: 1 impulse { x: 1 } }"), kTooMany,
       "batch[0].impulse"},
      // SpawnBodies
      {"SpawnBodies", "sequence: 1 bodies { shape { sphere { radius: 1 } } }", kMissing, "client"},
      {"SpawnBodies", "client: 5 bodies { shape { sphere { radius: 1 } } }", kMissing, "sequence"},
      {"SpawnBodies", "client: 5 sequence: 18446744073709551615 bodies { shape { sphere { radius: 1 } } }", kBad,
       "sequence"},
      {"SpawnBodies", "client: 5 sequence: 1", kMissing, "bodies"},
      {"SpawnBodies", Spawn(""), kBad, "bodies[0].shape"},
      {"SpawnBodies", Spawn("shape { sphere { radius: 0 } }"), kBad, "bodies[0].shape.sphere.radius"},
      {"SpawnBodies", Spawn("shape { sphere { radius: nan } }"), kBad, "bodies[0].shape.sphere.radius"},
      {"SpawnBodies", Spawn("shape { sphere { radius: 1e6 } }"), kBad, "bodies[0].shape.sphere.radius"},
      {"SpawnBodies", Spawn("shape { box { size { x: 1 y: 1 } } }"), kBad, "bodies[0].shape.box.size.z"},
      {"SpawnBodies", Spawn("shape { capsule { radius: 1 height: 1 } }"), kBad, "bodies[0].shape.capsule.height"},
      {"SpawnBodies", Spawn("shape { cylinder { radius: 1 } }"), kBad, "bodies[0].shape.cylinder.height"},
      {"SpawnBodies", Spawn("shape { plane { normal { y: 1 } } }"), kBad, "bodies[0].shape"},
      {"SpawnBodies", Spawn("shape { named: \"nothing\" }"), kBad, "bodies[0].shape.named"},
      {"SpawnBodies", Spawn("shape { hull { points { x: 1 } } }"), kBad, "bodies[0].shape.hull.points"},
      {"SpawnBodies", Spawn("shape { hull { points { } points { x: 1 } points { z: 1 } points { x: 1 z: 1 } } }"), kBad,
       "bodies[0].shape.hull.points"},
      {"SpawnBodies",
       Spawn("shape { hull { points { x: 5 } points { x: 6 } points { x: 5 y: 1 } points { x: 5 z: 1 } } }"), kBad,
       "bodies[0].shape.hull.points"},
      {"SpawnBodies", Spawn("shape { hull { points { x: nan } points { } points { y: 1 } points { z: 1 } } }"), kBad,
       "bodies[0].shape.hull.points[0].x"},
      {"SpawnBodies", Spawn("shape { hull { " + Times(65, "points { }") + " } }"), kBad, "bodies[0].shape.hull.points"},
      {"SpawnBodies", Spawn("shape { compound { } }"), kBad, "bodies[0].shape.compound.children"},
      {"SpawnBodies", Spawn("shape { compound { children { shape { compound { } } } } }"), kBad,
       "bodies[0].shape.compound.children[0].shape.compound"},
      {"SpawnBodies",
       "client: 5 sequence: 1 " + Times(65, "bodies { shape { hull { " + Times(64, "points { }") + "} } }"), kTooMany,
       "bodies"},
      {"SpawnBodies", Ball("id: 7"), kConflict, "bodies[0].id"},
      {"SpawnBodies", Ball("mass: 0"), kBad, "bodies[0].mass"},
      {"SpawnBodies", Ball("mass: -1"), kBad, "bodies[0].mass"},
      {"SpawnBodies", Ball("mass: nan"), kBad, "bodies[0].mass"},
      {"SpawnBodies", Ball("density: 1e9"), kBad, "bodies[0].density"},
      {"SpawnBodies", Ball("position { x: inf }"), kBad, "bodies[0].position.x"},
      {"SpawnBodies", Ball("position { x: 2e6 }"), kBad, "bodies[0].position.x"},
      {"SpawnBodies", Ball("orientation { }"), kBad, "bodies[0].orientation"},
      {"SpawnBodies", Ball("orientation { w: 1 } turn { degrees: 5 axis { y: 1 } }"), kBad, "bodies[0].turn"},
      {"SpawnBodies", Ball("velocity { y: 2e4 }"), kBad, "bodies[0].velocity.y"},
      {"SpawnBodies", Ball("angular_velocity { y: nan }"), kBad, "bodies[0].angular_velocity.y"},
      {"SpawnBodies", Ball("material: \"rubber\""), kBad, "bodies[0].material"},
      {"SpawnBodies", Ball("array { x: 1025 }"), kTooMany, "bodies"},
      {"SpawnBodies", Ball("array { x: 4294967295 y: 4294967295 z: 4294967295 }"), kTooMany, "bodies"},
      {"SpawnBodies", Ball("asleep: true velocity { x: 1 }"), kBad, "bodies[0].asleep"},
      // RemoveBodies
      {"RemoveBodies", "sequence: 1 body: 1", kMissing, "client"},
      {"RemoveBodies", "client: 5 body: 1", kMissing, "sequence"},
      {"RemoveBodies", "client: 5 sequence: 1", kMissing, "body"},
      {"RemoveBodies", "client: 5 sequence: 1 body: 0", kBad, "body[0]"},
      {"RemoveBodies", "client: 5 sequence: 1 " + Times(1025, "body: 1"), kTooMany, "body"},
      // CastRays
      {"CastRays", "", kMissing, "rays"},
      {"CastRays", Ray("length: 1"), kBad, "rays[0].direction"},
      {"CastRays", Ray("direction { x: nan } length: 1"), kBad, "rays[0].direction"},
      {"CastRays", Ray("direction { x: 1 }"), kBad, "rays[0].length"},
      {"CastRays", Ray("direction { x: 1 } length: -1"), kBad, "rays[0].length"},
      {"CastRays", Ray("direction { x: 1 } length: 1e6"), kBad, "rays[0].length"},
      {"CastRays", Ray("direction { x: 1 } length: nan"), kBad, "rays[0].length"},
      {"CastRays", Ray("direction { x: 1 } length: 1 origin { z: inf }"), kBad, "rays[0].origin.z"},
      {"CastRays", Times(257, Ray("direction { x: 1 } length: 1")), kTooMany, "rays"},
      // Record
      {"Record", "from_tick: 1", kBad, "from_tick", grpc::StatusCode::OUT_OF_RANGE},
      {"Record", "", kBad, "from_tick", grpc::StatusCode::OUT_OF_RANGE},
      {"Record", "from_tick: -5", kBad, "from_tick", grpc::StatusCode::OUT_OF_RANGE},
      {"Record", "from_tick: 1000000000 hash_every: -1", kBad, "hash_every"},
  };
  // What is to be watched: alone, and in a game's stream.
  const std::vector<Case> views{
      {"", "rate: -1", kBad, "rate"},
      {"", "rate: nan", kBad, "rate"},
      {"", "rate: inf", kBad, "rate"},
      {"", "rate: 1001", kBad, "rate"},
      {"", "precision: 7", kBad, "precision"},
      {"", "encoding: 9", kBad, "encoding"},
      {"", "precision: EXACT encoding: BITS", kConflict, "encoding"},
      {"", "view { box { min { x: nan } } }", kBad, "view.box.min.x"},
      {"", "view { box { min { x: 5 } max { x: 4 } } }", kBad, "view.box.max"},
      {"", "view { box { max { z: 1e7 } } }", kBad, "view.box.max.z"},
      {"", "view { sphere { } }", kBad, "view.sphere.radius"},
      {"", "view { sphere { radius: -2 } }", kBad, "view.sphere.radius"},
      {"", "view { sphere { radius: 5 centre { y: nan } } }", kBad, "view.sphere.centre.y"},
      {"", "view { frustum { } }", kMissing, "view.frustum.sides"},
      {"", "view { frustum { " + Times(9, "sides { normal { x: 1 } }") + "} }", kTooMany, "view.frustum.sides"},
      {"", "view { frustum { sides { offset: 1 } } }", kBad, "view.frustum.sides[0].normal"},
      {"", "view { frustum { sides { normal { x: 1 } offset: nan } } }", kBad, "view.frustum.sides[0].offset"},
      {"", "view { min_y: 5 max_y: 4 frustum { sides { normal { x: 1 } } } }", kBad, "view.max_y"},
      {"", "level_of_detail { full_within: -1 }", kBad, "level_of_detail.full_within"},
      {"", "level_of_detail { eye { x: inf } full_within: 5 }", kBad, "level_of_detail.eye.x"},
  };
  for (const Case& view : views) {
    out.push_back({"StreamReplicas", view.request, view.reason, view.field});
    out.push_back({"Play", "watch { " + view.request + " }", view.reason, view.field});
  }
  out.push_back({"Play", "inputs { impulse { sequence: 1 body: 1 impulse { x: 1 } } }", kMissing, "inputs.client"});
  out.push_back(
      {"Play", "inputs { " + Batch("body: 1 impulse { x: nan }") + " }", kBad, "inputs.impulse[0].impulse.x"});
  return out;
}

template <class Message>
Message Parse(const std::string& text) {
  Message out;
  EXPECT_TRUE(google::protobuf::TextFormat::ParseFromString(text, &out)) << text;
  return out;
}

class Caller {
 public:
  explicit Caller(const std::string& endpoint)
      : channel_(grpc::CreateChannel(endpoint, grpc::InsecureChannelCredentials())),
        simulation_(v1::Simulation::NewStub(channel_)),
        recording_(v1::Recording::NewStub(channel_)) {}

  grpc::Status Call(const Case& c) {
    const std::string rpc = c.rpc;
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(20));
    if (rpc == "ApplyImpulses") {
      v1::ImpulseSummary summary;
      const auto stream = simulation_->ApplyImpulses(&context, &summary);
      stream->Write(Parse<v1::ImpulseBatch>(c.request));
      return stream->Finish();
    }
    if (rpc == "Play") {
      const auto stream = simulation_->Play(&context);
      stream->Write(Parse<v1::PlayRequest>(c.request));
      return End<v1::PlayResponse>(stream.get());
    }
    if (rpc == "StreamReplicas") {
      const auto stream = simulation_->StreamReplicas(&context, Parse<v1::StreamReplicasRequest>(c.request));
      return End<v1::ReplicaFrame>(stream.get());
    }
    if (rpc == "Record") {
      const auto stream = recording_->Record(&context, Parse<v1::RecordRequest>(c.request));
      return End<v1::Recorded>(stream.get());
    }
    if (rpc == "SpawnBodies") {
      v1::SpawnBodiesResponse response;
      return simulation_->SpawnBodies(&context, Parse<v1::SpawnBodiesRequest>(c.request), &response);
    }
    if (rpc == "RemoveBodies") {
      v1::RemoveBodiesResponse response;
      return simulation_->RemoveBodies(&context, Parse<v1::RemoveBodiesRequest>(c.request), &response);
    }
    v1::CastRaysResponse response;
    return simulation_->CastRays(&context, Parse<v1::CastRaysRequest>(c.request), &response);
  }

  // The hashes of all bodies, after one tick that is to come.
  v1::StateHashes Hashes() {
    v1::GetWorldResponse world;
    grpc::ClientContext asking, context;
    EXPECT_TRUE(simulation_->GetWorld(&asking, {}, &world).ok());
    context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(20));
    v1::RecordRequest request;
    request.set_from_tick(world.tick() + 50);
    const auto stream = recording_->Record(&context, request);
    v1::Recorded recorded;
    while (stream->Read(&recorded) && !recorded.has_hashes()) {
    }
    context.TryCancel();
    return recorded.hashes();
  }

 private:
  // Reads to the end.
  template <class Message, class Stream>
  static grpc::Status End(Stream* stream) {
    Message message;
    while (stream->Read(&message)) ADD_FAILURE() << "an answer: " << message.ShortDebugString();
    return stream->Finish();
  }

  std::shared_ptr<grpc::Channel> channel_;
  std::unique_ptr<v1::Simulation::Stub> simulation_;
  std::unique_ptr<v1::Recording::Stub> recording_;
};

TEST(BadInput, IsRefusedWithCodeReasonAndFieldAndChangesNoBit) {
  v1::WorldSpec world;
  world.set_name("still");
  world.mutable_gravity();
  v1::Body* body = world.add_bodies();
  body->set_id(1);
  body->mutable_shape()->mutable_box()->mutable_size()->set_x(1);
  body->mutable_shape()->mutable_box()->mutable_size()->set_y(1);
  body->mutable_shape()->mutable_box()->mutable_size()->set_z(1);
  body->mutable_array()->set_x(20);
  body->mutable_array()->mutable_spacing()->set_x(2);
  body->set_asleep(true);
  PlayIn(world, 1, [](const std::vector<std::string>& endpoints) {
    Caller caller(endpoints[0]);
    const v1::StateHashes before = caller.Hashes();
    EXPECT_EQ(before.hash_size(), 20);
    const std::vector<Case> cases = Cases();
    EXPECT_GE(cases.size(), 80u);
    for (const Case& c : cases) {
      SCOPED_TRACE(absl::StrCat(c.rpc, " { ", c.request.substr(0, 200), " }"));
      const grpc::Status s = caller.Call(c);
      EXPECT_EQ(s.error_code(), c.code) << s.error_message();
      v1::ErrorStatus status;
      ASSERT_TRUE(status.ParseFromString(s.error_details())) << s.error_message();
      if (status.details_size() != 1) continue;
      v1::ErrorDetail detail;
      ASSERT_TRUE(status.details(0).UnpackTo(&detail));
      EXPECT_EQ(v1::Reason_Name(detail.reason()), v1::Reason_Name(c.reason));
      const std::string prefix = std::string(c.rpc) == "Play" && detail.field().starts_with("request[0].")
                                     ? detail.field().substr(std::string("request[0].").size())
                                     : detail.field();
      const std::string field = prefix.starts_with("watch.") ? prefix.substr(6) : prefix;
      EXPECT_EQ(field, c.field);
      EXPECT_FALSE(detail.remedy().empty());
    }
    const v1::StateHashes after = caller.Hashes();
    EXPECT_GT(after.tick(), before.tick());
    EXPECT_TRUE(std::equal(before.body().begin(), before.body().end(), after.body().begin(), after.body().end()));
    EXPECT_TRUE(std::equal(before.hash().begin(), before.hash().end(), after.hash().begin(), after.hash().end()));
  });
}

}  // namespace
}  // namespace aureole
