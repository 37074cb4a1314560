// Each message that a stranger can send, and each file that a user can open, changed at random.
#include <google/protobuf/stubs/logging.h>
#include <google/protobuf/text_format.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <functional>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include <absl/strings/str_cat.h>

#include "aureole/v1/recording.pb.h"
#include "aureole/v1/simulation.pb.h"
#include "client/cli/mcap_writer.h"
#include "client/cli/recording.h"
#include "client/src/replica_decoder.h"
#include "server/core/region.h"
#include "server/physics/bullet_engine.h"
#include "server/replay/replay.h"
#include "server/transport/frame_codec.h"
#include "server/transport/input_codec.h"
#include "server/transport/input_messages.h"
#include "server/transport/ray_service.h"
#include "server/transport/replica_publisher.h"
#include "server/transport/world_json.h"
#include "server/transport/world_spec.h"
#include "tests/fuzz/mutate.h"

namespace aureole {
namespace {

constexpr int kRounds = 3000;

// Protobuf says on stderr which of the strings are no text.
const google::protobuf::LogSilencer kSilence;

template <class Message>
Message Parse(const std::string& text) {
  Message out;
  EXPECT_TRUE(google::protobuf::TextFormat::ParseFromString(text, &out)) << text;
  return out;
}

// Calls `take` with messages that grow out of the seeds by more and more changes, some of them after a change of their
// bytes.
template <class Message>
void Fuzz(const std::vector<std::string>& seeds, const std::function<void(const Message&)>& take,
          int rounds = kRounds) {
  sim::Random random(17);
  for (int round = 0; round < rounds; ++round) {
    Message message = Parse<Message>(seeds[static_cast<size_t>(random.Below(static_cast<int>(seeds.size())))]);
    for (int i = random.Below(12); i > 0; --i) fuzz::Mutate(&message, &random);
    if (random.Chance(0.2)) {
      std::string bytes = message.SerializeAsString();
      fuzz::Mutate(&bytes, &random);
      if (!message.ParseFromString(bytes)) continue;
    }
    take(message);
  }
}

const InputScene& Scene() {
  static const InputScene scene(
      Parse<v1::WorldSpec>("name: 'w' shapes { key: 'crate' value { box { size { x: 1 y: 1 z: 1 } } } } "
                           "materials { key: 'ice' value { friction: 0 } }"),
      16'000);
  return scene;
}

const std::vector<std::string>& Views() {
  static const std::vector<std::string> views{
      "rate: 30 view { box { min { x: -5 } max { x: 5 z: 5 } } }",
      "rate: 60 view { sphere { centre { x: 3 } radius: 40 } } level_of_detail { eye { x: 1 } full_within: 20 }",
      "view { frustum { sides { normal { x: 1 } offset: -3 } sides { normal { z: 1 } } } min_y: 0 max_y: 9 }",
      "precision: EXACT velocities: true", "precision: COARSE encoding: BITS"};
  return views;
}

TEST(FuzzMessage, StreamReplicasRequest) {
  int taken = 0;
  Fuzz<v1::StreamReplicasRequest>(Views(), [&](const v1::StreamReplicasRequest& request) {
    SpecCheck check;
    const ReplicaRequest read = ReplicaRequest::Read(Path(), request, 16'000, &check);
    if (!check.ok()) return;
    ++taken;
    ASSERT_GE(read.period, 1);
    read.view.Selects({3, -4});
    ASSERT_GE(read.detail.Every({3, -4}), 1);
  });
  EXPECT_GT(taken, kRounds / 20);
}

const std::vector<std::string>& Batches() {
  static const std::vector<std::string> batches{
      "client: 5 impulse { sequence: 1 body: 7 impulse { x: 1 } at_point { y: 2 } }",
      "client: 5 impulse { sequence: 2 sphere { centre { x: 3 } radius: 4 outward: 5 fades: true } }",
      "impulse { sequence: 3 body: 7 force { z: 1 } torque { x: 1 } duration { nanos: 50000000 } at_body_point { } }",
      "client: 6 impulse { sequence: 4 body: 7 velocity_change { x: 1 } spin_change { y: 1 } }"};
  return batches;
}

void TakeBatch(const v1::ImpulseBatch& batch, int* taken) {
  for (const Input& input : ReadBatch(Scene(), Path(), batch, 9).inputs) {
    ++*taken;
    ASSERT_TRUE(CheckLiveInput(input).ok()) << CheckLiveInput(input) << batch.DebugString();
    IsWithin(Scene().limits, input);
  }
}

TEST(FuzzMessage, ImpulseBatch) {
  int taken = 0;
  Fuzz<v1::ImpulseBatch>(Batches(), [&](const v1::ImpulseBatch& batch) { TakeBatch(batch, &taken); });
  EXPECT_GT(taken, kRounds / 20);
}

TEST(FuzzMessage, PlayRequest) {
  std::vector<std::string> seeds{"acknowledged_tick: 5"};
  for (const std::string& view : Views()) seeds.push_back("watch { " + view + " }");
  for (const std::string& batch : Batches()) seeds.push_back("inputs { " + batch + " }");
  int taken = 0;
  Fuzz<v1::PlayRequest>(seeds, [&](const v1::PlayRequest& request) {
    SpecCheck check;
    ReplicaRequest::Read(Path() / "watch", request.watch(), 16'000, &check);
    TakeBatch(request.inputs(), &taken);
  });
  EXPECT_GT(taken, 20);
}

TEST(FuzzMessage, SpawnBodiesRequest) {
  const std::vector<std::string> seeds{
      "client: 5 sequence: 1 bodies { shape { sphere { radius: 0.5 } } mass: 2 position { y: 3 } array { x: 3 } }",
      "client: 5 sequence: 1 bodies { shape { named: 'crate' } material: 'ice' velocity { x: 1 } }",
      "client: 5 sequence: 9 bodies { shape { hull { points { x: 1 y: 1 z: 1 } points { x: -1 y: -1 z: 1 } "
      "points { x: -1 y: 1 z: -1 } points { x: 1 y: -1 z: -1 } } } density: 300 turn { axis { y: 1 } degrees: 30 } }",
      "client: 5 sequence: 9 bodies { shape { compound { children { shape { capsule { radius: 1 height: 3 } } } "
      "children { position { x: 2 } shape { cylinder { radius: 1 height: 1 } } } } } ccd: true }"};
  int taken = 0;
  Fuzz<v1::SpawnBodiesRequest>(seeds, [&](const v1::SpawnBodiesRequest& request) {
    SpecCheck check;
    CostOf(request, &check);
    if (!check.ok()) return;
    const std::vector<Input> inputs = ReadSpawns(Scene(), request, &check);
    if (!check.ok()) return;
    ++taken;
    ASSERT_LE(inputs.size(), size_t{kMostInputsPerMessage});
    // What is accepted can be told to the other servers.
    google::protobuf::RepeatedPtrField<v1::Input> told;
    EncodeInputs(inputs, &told);
    std::vector<Input> heard;
    const absl::Status s = DecodeInputs(told, &heard);
    ASSERT_TRUE(s.ok()) << s << request.DebugString();
    ASSERT_EQ(heard.size(), inputs.size());
    // And lives in an engine.
    const std::unique_ptr<Engine> engine = MakeBulletEngine(Environment());
    Tick n = 0;
    for (Input& input : heard) {
      if (input.spawn->position.norm() > 1e3 || ++n > 5) break;
      auto body = std::make_shared<BodySpec>(*input.spawn);
      body->id = kFirstLiveId + static_cast<BodyId>(n);
      input.body = body->id;
      input.spawn = body;
      engine->Apply(input);
      engine->Step(n);
    }
  });
  EXPECT_GT(taken, kRounds / 20);
}

TEST(FuzzMessage, RemoveBodiesRequest) {
  Fuzz<v1::RemoveBodiesRequest>({"client: 5 sequence: 1 body: 3 body: 4"}, [](const v1::RemoveBodiesRequest& request) {
    SpecCheck check;
    CostOf(request, &check);
    if (!check.ok()) return;
    for (const Input& input : ReadRemovals(Scene(), request, &check)) {
      if (!check.ok()) return;
      ASSERT_TRUE(CheckLiveInput(input).ok());
    }
  });
}

TEST(FuzzMessage, CastRaysRequest) {
  const std::unique_ptr<Engine> engine = MakeBulletEngine(Environment());
  BodySpec ball;
  ball.id = 1;
  auto shape = std::make_shared<Shape>();
  shape->radius = 1;
  ball.shape = shape;
  engine->Spawn(ball);
  int taken = 0;
  Fuzz<v1::CastRaysRequest>({"rays { origin { y: 9 } direction { y: -1 } length: 20 }"},
                            [&](const v1::CastRaysRequest& request) {
                              SpecCheck check;
                              for (const ClientRay& ray : ReadRays(request, &check)) {
                                if (!check.ok()) continue;
                                ++taken;
                                const auto hit = engine->CastRay(ray.from, ray.to);
                                ASSERT_TRUE(!hit.has_value() || (hit->fraction >= 0 && hit->fraction <= 1));
                              }
                            });
  EXPECT_GT(taken, 100);
}

LayoutChange HalfPlanes() {
  constexpr double kInf = std::numeric_limits<double>::infinity();
  return {2, {{-kInf, 0, -kInf, kInf}, {0, kInf, -kInf, kInf}}, {0, 1}, {0, 1}};
}

// What a region is told when it joins is refused, or is of the layout with which it joins.
TEST(FuzzMessage, Welcome) {
  const World world(*Layout::Columns({}));
  LiveInputs live;
  Input drop;
  drop.source = 4;
  drop.sequence = 1;
  drop.kind = Input::Kind::kSpawn;
  auto body = std::make_shared<BodySpec>();
  body->shape = std::make_shared<Shape>();
  drop.spawn = body;
  live.Deliver({drop}, 5, 5, true);
  std::string seed;
  Writer writer(&seed);
  writer(Division(HalfPlanes()));
  live.Teach(writer);
  sim::Random random(7);
  int taken = 0;
  for (int round = 0; round < kRounds; ++round) {
    Frame frame;
    frame.from = 0;
    frame.to = {1};
    frame.tick = 4;
    frame.round = kWelcome;
    frame.welcome = seed;
    if (round > 0) fuzz::Mutate(&frame.welcome, &random);
    const auto region = *Region::Join(world, 1, MakeBulletEngine(world.environment), HalfPlanes());
    if (!region->Receive(frame).ok()) {
      EXPECT_GT(round, 0);
      continue;
    }
    ++taken;
    std::vector<Frame> out;
    region->Advance(&out);
    EXPECT_EQ(region->phase(), Phase::kBegin);
    EXPECT_EQ(region->layout_epoch(), 2u);
  }
  EXPECT_GT(taken, 10);
}

TEST(FuzzMessage, PeerFrame) {
  Frame frame;
  frame.from = 1;
  frame.to = {0};
  frame.tick = 5;
  frame.auras.push_back({3, {{0, 0, 0}, {1, 1, 1}}});
  Graph graph;
  graph.of = 1;
  graph.edges = {{3, 4}};
  graph.fragments.push_back({{3}, 3, 2, {{0, 1.5}}, kNoRegion});
  Input kick;
  kick.source = 9;
  kick.sequence = 2;
  kick.body = 3;
  Input layout;
  layout.source = kControlSource;
  layout.sequence = 1;
  layout.kind = Input::Kind::kLayout;
  layout.layout = std::make_shared<const LayoutChange>(HalfPlanes());
  graph.inputs = {kick, layout};
  graph.emptied = true;
  frame.welcome = "welcome";
  frame.graphs = {graph};
  Transfer transfer;
  transfer.ids = {3, 4};
  transfer.epochs = {1, 1};
  transfer.state = "state";
  frame.transfers = {transfer};
  const std::string seed = EncodeFrame(frame);
  ASSERT_TRUE(DecodeFrame(seed, 1, 0).ok());
  sim::Random random(5);
  for (int round = 0; round < 10 * kRounds; ++round) {
    std::string bytes = seed;
    fuzz::Mutate(&bytes, &random);
    if (absl::StatusOr<Frame> read = DecodeFrame(bytes, 1, 0); read.ok()) EncodeFrame(*read);
  }
}

TEST(FuzzMessage, EngineState) {
  const std::unique_ptr<Engine> engine = MakeBulletEngine(Environment());
  auto shape = std::make_shared<Shape>();
  shape->kind = ShapeKind::kBox;
  shape->half = {0.5, 0.5, 0.5};
  for (BodyId id = 1; id <= 3; ++id) {
    BodySpec box;
    box.id = id;
    box.shape = shape;
    box.position = {0, 0.99 * static_cast<double>(id), 0};
    engine->Spawn(box);
  }
  for (Tick n = 1; n <= 5; ++n) engine->Step(n);
  const std::string seed = engine->Save(engine->Ids());
  sim::Random random(6);
  int taken = 0;
  for (int round = 0; round < kRounds; ++round) {
    std::string bytes = seed;
    fuzz::Mutate(&bytes, &random);
    const std::unique_ptr<Engine> other = engine->Scratch();
    if (!other->Restore(bytes).ok()) continue;
    ++taken;
    other->Step(6);
  }
  EXPECT_GT(taken, 10);
}

TEST(FuzzMessage, ReplicaFrame) {
  const std::vector<std::string> seeds{
      "tick: 5 region: 1 cells { x: 1 z: -1 new_id: 3 new_id: 2 new_epoch: 0 new_epoch: 1 new_position: 5 "
      "new_position: 6 new_position: 7 new_position: 8 new_position: 9 new_position: 10 new_orientation: 1 "
      "new_orientation: 2 new_orientation: 3 new_orientation: 4 new_orientation: 5 new_orientation: 6 new_largest: 3 "
      "new_largest: 0 slept: 3 }",
      "tick: 6 base_tick: 5 cells { x: 1 z: -1 id: 3 position: 1 position: 0 position: 0 orientation: 0 orientation: 0 "
      "orientation: 1 gone: 5 why: 2 moved_epoch: 2 moved_tick: 0 }",
      "tick: 6 base_tick: 5 dropped: 1 dropped: -1 passed: 9 passed_region: 2 passed_epoch: 3 passed_tick: 1",
      "tick: 6 base_tick: 5 cells { x: 1 z: -1 bits: 'abcdefghij' }"};
  sim::Random random(3);
  for (const bool velocities : {false, true}) {
    auto decoder = std::make_unique<client::ReplicaDecoder>(v1::FINE, velocities);
    Fuzz<v1::ReplicaFrame>(seeds, [&](const v1::ReplicaFrame& frame) {
      std::string error;
      // A frame that follows, more often than chance has it.
      v1::ReplicaFrame next = frame;
      if (random.Chance(0.7)) next.set_base_tick(decoder->tick());
      if (random.Chance(0.7)) next.set_tick(decoder->tick() + 1);
      if (!decoder->Apply(next, &error)) decoder = std::make_unique<client::ReplicaDecoder>(v1::FINE, velocities);
      decoder->ForEach([&](uint64_t id) { decoder->Get(id); });
    });
  }
}

TEST(FuzzMessage, WorldSpec) {
  const absl::StatusOr<v1::WorldSpec> demo = SpecFromFile(AUREOLE_WORLDS "/demo.json");
  ASSERT_TRUE(demo.ok()) << demo.status();
  std::string seed;
  google::protobuf::TextFormat::PrintToString(*demo, &seed);
  int taken = 0;
  Fuzz<v1::WorldSpec>(
      {seed, "name: 'small' bodies { shape { sphere { radius: 1 } } }"},
      [&](const v1::WorldSpec& spec) { taken += WorldFromSpec(spec).ok(); }, kRounds / 4);
  EXPECT_GT(taken, 10);
}

TEST(FuzzMessage, RecordedInput) {
  int taken = 0;
  Fuzz<v1::Input>(
      {"tick: 5 source: 1 sequence: 2 kind: 3 body: 7 linear: 1 linear: 2 linear: 3",
       "tick: 5 source: 1 sequence: 2 kind: 1 body: 2305843009213693952 spawn { shape { kind: 1 radius: 1 } "
       "mass: 1 orientation: 0 orientation: 0 orientation: 0 orientation: 1 material: 0.5 material: 0 "
       "material: 0 material: 0 material: 0 material: 0 }"},
      [&](const v1::Input& input) {
        Input read;
        if (!ReadRecordedInput(input, &read).ok()) return;
        ++taken;
        google::protobuf::RepeatedPtrField<v1::Input> again;
        RecordInputs({read}, &again);
        ASSERT_TRUE(ReadRecordedInput(again[0], &read).ok());
      });
  EXPECT_GT(taken, 100);
}

TEST(FuzzMessage, RecordingFile) {
  const std::filesystem::path file =
      std::filesystem::path(testing::TempDir()) / absl::StrCat("fuzz-", getpid(), ".mcap");
  {
    auto writer = McapWriter::Open(file.string());
    ASSERT_TRUE(writer.ok()) << writer.status();
    const auto write = [&](const std::string& topic, const google::protobuf::Message& m) {
      ASSERT_TRUE((*writer)->Write(topic, m.GetDescriptor(), 5, m.SerializeAsString()).ok());
    };
    write(kWorldTopic, Parse<v1::GetWorldResponse>("name: 'w' tick_us: 16000 endpoints: 'a:1'"));
    write("/region/0/snapshot", Parse<v1::Snapshot>("tick: 3 world { name: 'w' }"));
    write(kInputsTopic, Parse<v1::Input>("tick: 5 source: 1 sequence: 2 kind: 2 body: 7"));
    write("/region/0/hashes", Parse<v1::StateHashes>("tick: 5 body: 3 hash: 4"));
    ASSERT_TRUE((*writer)->Close().ok());
  }
  ASSERT_TRUE(ReadRecording(file.string()).ok());
  std::ifstream in(file, std::ios::binary);
  const std::string seed{std::istreambuf_iterator<char>(in), {}};
  sim::Random random(8);
  for (int round = 0; round < kRounds / 3; ++round) {
    std::string bytes = seed;
    fuzz::Mutate(&bytes, &random);
    std::ofstream(file, std::ios::binary | std::ios::trunc) << bytes;
    const absl::StatusOr<RecordedRun> run = ReadRecording(file.string());
    if (run.ok()) Replay::Begin(run->snapshots).status().IgnoreError();
  }
  std::filesystem::remove(file);
}

}  // namespace
}  // namespace aureole
