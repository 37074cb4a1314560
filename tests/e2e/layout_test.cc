// Where the servers of a world are and how they do, as real region servers tell it; what is fixed in it; what they
// serve.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/grpcpp.h>

#include <chrono>
#include <set>
#include <string>
#include <vector>

#include <google/protobuf/util/message_differencer.h>

#include "aureole/v1/recording.grpc.pb.h"
#include "aureole/v1/simulation.grpc.pb.h"
#include "server/transport/layout_service.h"
#include "server/transport/world_json.h"
#include "tests/e2e/running_world.h"

namespace aureole {
namespace {

using google::protobuf::util::MessageDifferencer;

// Two regions; a box that slides over the border, on a plane, under a mover.
v1::WorldSpec Sliding() {
  v1::WorldSpec spec;
  spec.set_name("sliding");
  spec.mutable_layout()->mutable_columns()->add_edges(0);
  spec.add_statics()->mutable_shape()->mutable_plane()->mutable_normal()->set_y(1);
  v1::Mover* mover = spec.add_movers();
  mover->set_id(50);
  mover->mutable_shape()->mutable_sphere()->set_radius(2);
  mover->add_keys()->mutable_position()->set_y(20);
  mover->add_keys()->mutable_position()->set_y(30);
  mover->mutable_keys(1)->mutable_time()->set_seconds(2);
  mover->mutable_period()->set_seconds(3);
  for (int i = 0; i < 4; ++i) {
    v1::Body* b = spec.add_bodies();
    b->mutable_shape()->mutable_box()->mutable_size()->set_x(1);
    b->mutable_shape()->mutable_box()->mutable_size()->set_y(1);
    b->mutable_shape()->mutable_box()->mutable_size()->set_z(1);
    b->mutable_position()->set_x(0.2);
    b->mutable_position()->set_y(0.5);
    b->mutable_position()->set_z(10 * i);
  }
  return spec;
}

std::unique_ptr<v1::Simulation::Stub> Connect(const std::string& endpoint) {
  return v1::Simulation::NewStub(grpc::CreateChannel(endpoint, grpc::InsecureChannelCredentials()));
}

void SetDeadline(grpc::ClientContext* context) {
  context->set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(30));
}

TEST(Layout, EachServerTellsTheLayoutOnceAndItsStatusAgainAndAgain) {
  PlayIn(Sliding(), 2, [](const std::vector<std::string>& endpoints) {
    for (int r = 0; r < 2; ++r) {
      grpc::ClientContext context;
      SetDeadline(&context);
      v1::WatchLayoutRequest request;
      request.set_auras(true);
      const auto stub = Connect(endpoints[static_cast<size_t>(r)]);
      const auto stream = stub->WatchLayout(&context, request);
      v1::LayoutUpdate update;
      ASSERT_TRUE(stream->Read(&update));
      EXPECT_EQ(update.world().name(), "sliding");
      EXPECT_THAT(update.world().endpoints(), testing::ElementsAreArray(endpoints));
      EXPECT_EQ(update.world().region(), r);
      EXPECT_EQ(update.world().layout(1).min_x(), 0);
      v1::RegionStatus status;
      int64_t last = 0;
      for (int n = 0; n < 4; ++n) {
        ASSERT_TRUE(stream->Read(&update));
        EXPECT_FALSE(update.has_world());
        status = update.status();
        EXPECT_EQ(status.region(), r);
        EXPECT_GT(status.tick(), last);
        last = status.tick();
        EXPECT_EQ(status.bodies(), r == 1 ? 4 : 0);
      }
      EXPECT_GT(status.frame_max_ms(), 0);
      EXPECT_GE(status.frame_max_ms(), status.frame_mean_ms());
      EXPECT_GT(status.real_time_factor(), 0.1);
      EXPECT_EQ(status.auras(), r == 1 ? 4 : 0) << "all stand on the border";
      ASSERT_EQ(status.aura_size(), r == 1 ? 24 : 0);
      if (r == 1) {
        EXPECT_LT(status.aura(0), -0.25f);
        EXPECT_GT(status.aura(3), 0.65f);
      }
      context.TryCancel();
      stream->Finish();
    }
  });
}

TEST(Layout, StatusWithoutAurasHasNone) {
  PlayIn(Sliding(), 2, [](const std::vector<std::string>& endpoints) {
    grpc::ClientContext with_context, context;
    SetDeadline(&with_context);
    SetDeadline(&context);
    v1::WatchLayoutRequest auras;
    auras.set_auras(true);
    const auto stub = Connect(endpoints[1]);
    const auto with = stub->WatchLayout(&with_context, auras);
    const auto without = stub->WatchLayout(&context, {});
    v1::LayoutUpdate update;
    for (int n = 0; n < 4; ++n) ASSERT_TRUE(with->Read(&update));
    EXPECT_GT(update.status().aura_size(), 0);
    for (int n = 0; n < 4; ++n) {
      ASSERT_TRUE(without->Read(&update));
      EXPECT_EQ(update.status().aura_size(), 0);
    }
    with_context.TryCancel();
    context.TryCancel();
  });
}

TEST(Layout, ManyMayWatchTheLayoutAloneAndAreToldNoStatus) {
  PlayIn(Sliding(), 2, [](const std::vector<std::string>& endpoints) {
    constexpr size_t kMany = LayoutService::kMostStreams + 8;
    const auto stub = Connect(endpoints[0]);
    v1::WatchLayoutRequest layout_only;
    layout_only.set_layout_only(true);
    layout_only.set_auras(true);
    std::vector<grpc::ClientContext> contexts(kMany + 1);
    std::vector<std::unique_ptr<grpc::ClientReader<v1::LayoutUpdate>>> streams;
    v1::LayoutUpdate update;
    for (size_t i = 0; i < kMany; ++i) {
      SetDeadline(&contexts[i]);
      streams.push_back(stub->WatchLayout(&contexts[i], layout_only));
      ASSERT_TRUE(streams.back()->Read(&update)) << i;
      EXPECT_EQ(update.world().endpoints_size(), 2);
      EXPECT_FALSE(update.has_status());
    }
    // One with status has its place, and is told one while the others are told nothing.
    SetDeadline(&contexts[kMany]);
    const auto with = stub->WatchLayout(&contexts[kMany], {});
    for (int n = 0; n < 3; ++n) ASSERT_TRUE(with->Read(&update));
    EXPECT_TRUE(update.has_status());
    for (grpc::ClientContext& c : contexts) c.TryCancel();
    EXPECT_FALSE(streams[0]->Read(&update));
    for (auto& s : streams) EXPECT_EQ(s->Finish().error_code(), grpc::StatusCode::CANCELLED);
  });
}

TEST(Layout, SceneTellsWhatIsFixedWithItsScripts) {
  PlayIn(Sliding(), 2, [](const std::vector<std::string>& endpoints) {
    std::vector<v1::GetWorldResponse> worlds(2);
    for (size_t r = 0; r < 2; ++r) {
      grpc::ClientContext context;
      SetDeadline(&context);
      v1::GetWorldRequest request;
      request.set_scene(true);
      ASSERT_TRUE(Connect(endpoints[r])->GetWorld(&context, request, &worlds[r]).ok());
    }
    ASSERT_EQ(worlds[0].scene_size(), 2);
    for (int i = 0; i < 2; ++i) EXPECT_TRUE(MessageDifferencer::Equals(worlds[0].scene(i), worlds[1].scene(i)));
    const auto* mover = &worlds[0].scene(0);
    const auto* plane = &worlds[0].scene(1);
    if (mover->body() != 50) std::swap(mover, plane);
    ASSERT_EQ(mover->body(), 50u);
    EXPECT_EQ(mover->shape().sphere().radius(), 2);
    ASSERT_EQ(mover->keys_size(), 2);
    EXPECT_EQ(mover->keys(1).time().seconds(), 2);
    EXPECT_EQ(mover->keys(1).position().y(), 30);
    EXPECT_EQ(mover->period().seconds(), 3);
    EXPECT_EQ(plane->shape().plane().normal().y(), 1);
    EXPECT_EQ(plane->keys_size(), 1);
    EXPECT_FALSE(plane->has_period());
    grpc::ClientContext context;
    v1::GetWorldResponse plain;
    ASSERT_TRUE(Connect(endpoints[0])->GetWorld(&context, {}, &plain).ok());
    EXPECT_EQ(plain.scene_size(), 0);
  });
}

TEST(Recording, OfMoreThanTheServerMakesIsRefusedAsBusy) {
  PlayIn(Sliding(), 2, [](const std::vector<std::string>& endpoints) {
    const auto stub = v1::Recording::NewStub(grpc::CreateChannel(endpoints[0], grpc::InsecureChannelCredentials()));
    v1::RecordRequest request;
    request.set_from_tick(1'000'000'000);
    std::vector<std::unique_ptr<grpc::ClientContext>> contexts;
    std::vector<std::unique_ptr<grpc::ClientReader<v1::Recorded>>> streams;
    for (int i = 0; i < 4; ++i) {
      contexts.push_back(std::make_unique<grpc::ClientContext>());
      SetDeadline(contexts.back().get());
      streams.push_back(stub->Record(contexts.back().get(), request));
    }
    // The server may hear of it before it hears of those.
    grpc::Status s;
    for (int tries = 0; tries < 20 && s.error_code() != grpc::StatusCode::RESOURCE_EXHAUSTED; ++tries) {
      grpc::ClientContext more;
      more.set_deadline(std::chrono::system_clock::now() + std::chrono::milliseconds(500));
      v1::Recorded none;
      const auto stream = stub->Record(&more, request);
      EXPECT_FALSE(stream->Read(&none));
      s = stream->Finish();
    }
    EXPECT_TRUE(s.error_message().starts_with("BUSY")) << s.error_message();
    for (auto& c : contexts) c->TryCancel();
    for (auto& stream : streams) stream->Finish();
  });
}

// What a gRPC server answers to the reflection's request to list its services.
std::string ListServices(const std::string& endpoint) {
  grpc::GenericStub stub(grpc::CreateChannel(endpoint, grpc::InsecureChannelCredentials()));
  grpc::ClientContext context;
  SetDeadline(&context);
  grpc::CompletionQueue queue;
  const auto call =
      stub.PrepareCall(&context, "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", &queue);
  const auto wait = [&queue] {
    void* tag = nullptr;
    bool ok = false;
    return queue.Next(&tag, &ok) && ok;
  };
  call->StartCall(nullptr);
  if (!wait()) return "";
  const grpc::Slice request("\x3a\x01*", 3);  // list_services = "*"
  call->WriteLast(grpc::ByteBuffer(&request, 1), {}, nullptr);
  if (!wait()) return "";
  grpc::ByteBuffer response;
  call->Read(&response, nullptr);
  if (!wait()) return "";
  grpc::Slice bytes;
  response.DumpToSingleSlice(&bytes);
  grpc::Status status;
  context.TryCancel();
  call->Finish(&status, nullptr);
  wait();
  return std::string(bytes.begin(), bytes.end());
}

TEST(Layout, ReflectionListsEveryService) {
  PlayIn(Sliding(), 2, [](const std::vector<std::string>& endpoints) {
    const std::string services = ListServices(endpoints[1]);
    for (const char* service :
         {"aureole.v1.Simulation", "aureole.v1.Recording", "aureole.v1.Peer", "grpc.health.v1.Health"}) {
      EXPECT_NE(services.find(service), std::string::npos) << service;
    }
  });
}

}  // namespace
}  // namespace aureole
