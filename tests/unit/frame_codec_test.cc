// Frames survive the wire bit for bit, cost what the bars allow, and nothing malformed gets through.
#include "server/transport/frame_codec.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "aureole/v1/peer.pb.h"
#include "server/transport/link_limits.h"

namespace aureole {
namespace {

Aura MakeAura(BodyId id, bool predicted) {
  Aura a;
  a.id = id;
  const float x = static_cast<float>(id % 1000) * 0.37f - 100;
  a.box = {{x, 0.1f, -3}, {x + 0.6f, 0.7f, -2.4f}};
  if (predicted) {
    a.owner = static_cast<RegionId>(id % 3);
    a.group = id - id % 7;
    a.energy = std::numeric_limits<float>::denorm_min();
    a.mass = 3.25f;
  }
  return a;
}

Input Force() {
  Input input;
  input.source = 4;
  input.sequence = 19;
  input.body = 11;
  input.frame = Input::Frame::kBody;
  input.point = {0.1, -0.0, 3};
  input.linear = {1.0 / 3, 0, 0};
  input.ticks = 77;
  return input;
}

Input Explosion() {
  Input input;
  input.source = ~1ull;
  input.sequence = 2;
  input.kind = Input::Kind::kVelocityChange;
  input.area = {{0.1, 0.2, 0.3}, 7.7, -0.1, true};
  return input;
}

Input Spawn() {
  auto ball = std::make_shared<Shape>();
  ball->radius = 0.1;
  auto hull = std::make_shared<Shape>();
  hull->kind = ShapeKind::kHull;
  hull->points = {{0.1, 0, 0}, {0, 1, -1}, {-1, -1, 0}, {0, 0, 1}};
  hull->radius = 1;
  auto body = std::make_shared<BodySpec>();
  auto shape = std::make_shared<Shape>();
  shape->kind = ShapeKind::kCompound;
  shape->children = {{{0.3, 0, 0}, Quat(0.6, 0.8, 0, 0), ball}, {{-0.3, 0, 0}, Quat::Identity(), hull}};
  body->shape = shape;
  body->mass = 1.0 / 7;
  body->position = {1e5 / 3, 2, 3};
  body->velocity = {0, 0.1, 0};
  body->angular_velocity = {0, 0, -0.7};
  body->material.friction = 0.3;
  body->ccd = true;
  Input input;
  input.source = 5;
  input.sequence = 1;
  input.kind = Input::Kind::kSpawn;
  input.spawn = body;
  return input;
}

Input NewLayout() {
  constexpr double kInf = std::numeric_limits<double>::infinity();
  auto change = std::make_shared<LayoutChange>();
  change->epoch = 7;
  change->regions = {{-kInf, 0.1, -kInf, kInf}, {}, {0.1, kInf, -kInf, -0.0}, {0.1, kInf, -0.0, kInf}};
  change->ranks = {3, 1, 0, 2};
  change->members = {0, 2, 3};
  Input input;
  input.source = kControlSource;
  input.sequence = 5;
  input.kind = Input::Kind::kLayout;
  input.layout = change;
  return input;
}

Frame MakeFrame(bool predicted) {
  Frame f;
  f.from = 1;
  f.to = {2};
  f.tick = 123456;
  f.round = predicted ? kBoxes : kTransfers;
  for (BodyId id : {7ull, 9ull, 1ull << 62, ~0ull, 3ull}) f.auras.push_back(MakeAura(id, predicted));
  f.gone = {5, ~0ull, 2};
  f.graphs.resize(2);
  Graph& g = f.graphs[0];
  g.of = 0;
  g.edges = {{1, ~0ull}, {7, 9}, {2, 3}};
  g.fragments.push_back({{4, 8, 15}, 2, 9, {{0, 12.5}, {3, 0.1}}, kNoRegion});
  g.fragments.push_back({{1ull << 63}, 1, 1, {}, 4});
  g.late = {{2, MakeAura(~0ull, false)}, {3, MakeAura(6, false)}};
  Input input;
  input.source = 4;
  input.sequence = 17;
  input.kind = Input::Kind::kVelocity;
  input.body = 11;
  input.linear = {0.1, -0.0, 1e-300};
  input.angular = {1, 2, 3};
  g.inputs = {input};
  input.kind = Input::Kind::kRemove;
  input.linear = input.angular = Vec3::Zero();
  g.inputs.push_back(input);
  g.inputs.push_back(Force());
  g.inputs.push_back(Explosion());
  g.inputs.push_back(Spawn());
  g.inputs.push_back(NewLayout());
  g.applied = {{{4, 16}, 1}, {{~0ull, 1}, 3}};
  f.graphs[1].of = 3;
  f.graphs[1].opened = {0, 7};
  f.graphs[1].closed = {2};
  f.graphs[1].emptied = true;
  f.welcome = std::string("\0\xff welcome", 10);
  Transfer t;
  t.ids = {11, 1ull << 62};
  t.epochs = {0, 4000000000u};
  t.cause = TransferCause::kBoundaryTraverse;
  t.state = std::string("\0\1\2 state", 9);
  Input spawn;
  spawn.kind = Input::Kind::kSpawn;
  spawn.tick = 123460;
  spawn.body = 11;
  t.pending = {spawn};
  f.transfers = {t, t};
  if (predicted) {
    f.away = {{21, 3, MakeAura(21, false).box}, {20, kNoRegion, MakeAura(20, false).box}};
    f.away_gone = {30, 29};
  }
  return f;
}

bool SameBits(const Vec3& a, const Vec3& b) { return std::memcmp(a.data(), b.data(), 3 * sizeof(double)) == 0; }

void ExpectSame(const Shape& a, const Shape& b) {
  EXPECT_EQ(a.kind, b.kind);
  EXPECT_EQ(a.radius, b.radius);
  EXPECT_TRUE(SameBits(a.half, b.half));
  ASSERT_EQ(a.points.size(), b.points.size());
  for (size_t i = 0; i < a.points.size(); ++i) EXPECT_TRUE(SameBits(a.points[i], b.points[i]));
  ASSERT_EQ(a.children.size(), b.children.size());
  for (size_t i = 0; i < a.children.size(); ++i) {
    EXPECT_TRUE(SameBits(a.children[i].position, b.children[i].position));
    EXPECT_EQ(a.children[i].orientation.coeffs(), b.children[i].orientation.coeffs());
    ExpectSame(*a.children[i].shape, *b.children[i].shape);
  }
}

void ExpectSame(const BodySpec& a, const BodySpec& b) {
  ExpectSame(*a.shape, *b.shape);
  EXPECT_EQ(a.mass, b.mass);
  EXPECT_TRUE(SameBits(a.position, b.position) && SameBits(a.velocity, b.velocity));
  EXPECT_TRUE(SameBits(a.angular_velocity, b.angular_velocity));
  EXPECT_EQ(a.orientation.coeffs(), b.orientation.coeffs());
  EXPECT_EQ(a.material.friction, b.material.friction);
  EXPECT_EQ(a.material.angular_damping, b.material.angular_damping);
  EXPECT_EQ(a.ccd, b.ccd);
  EXPECT_EQ(a.asleep, b.asleep);
}

void ExpectSame(const Graph& a, const Graph& b) {
  EXPECT_EQ(a.of, b.of);
  EXPECT_EQ(a.edges, b.edges);
  ASSERT_EQ(a.fragments.size(), b.fragments.size());
  for (size_t i = 0; i < a.fragments.size(); ++i) {
    EXPECT_EQ(a.fragments[i].known, b.fragments[i].known);
    EXPECT_EQ(a.fragments[i].id, b.fragments[i].id);
    EXPECT_EQ(a.fragments[i].bodies, b.fragments[i].bodies);
    EXPECT_EQ(a.fragments[i].mass_by_home, b.fragments[i].mass_by_home);
    EXPECT_EQ(a.fragments[i].gives_back, b.fragments[i].gives_back);
  }
  ASSERT_EQ(a.late.size(), b.late.size());
  for (size_t i = 0; i < a.late.size(); ++i) {
    EXPECT_EQ(a.late[i].to, b.late[i].to);
    EXPECT_EQ(a.late[i].aura, b.late[i].aura);
  }
  ASSERT_EQ(a.inputs.size(), b.inputs.size());
  for (size_t i = 0; i < a.inputs.size(); ++i) {
    const Input &p = a.inputs[i], &q = b.inputs[i];
    EXPECT_TRUE(p.source == q.source && p.sequence == q.sequence && p.kind == q.kind && p.body == q.body);
    EXPECT_TRUE(SameBits(p.linear, q.linear) && SameBits(p.angular, q.angular) && SameBits(p.point, q.point));
    EXPECT_TRUE(p.frame == q.frame && p.ticks == q.ticks);
    EXPECT_TRUE(SameBits(p.area.centre, q.area.centre) && p.area.radius == q.area.radius);
    EXPECT_TRUE(p.area.outward == q.area.outward && p.area.fades == q.area.fades);
    ASSERT_EQ(p.spawn != nullptr, q.spawn != nullptr);
    if (p.spawn != nullptr) ExpectSame(*p.spawn, *q.spawn);
    ASSERT_EQ(p.layout == nullptr, q.layout == nullptr);
    EXPECT_TRUE(p.layout == nullptr || *p.layout == *q.layout);
  }
  EXPECT_EQ(a.applied, b.applied);
  EXPECT_EQ(a.opened, b.opened);
  EXPECT_EQ(a.closed, b.closed);
  EXPECT_EQ(a.emptied, b.emptied);
}

void ExpectSame(const Frame& a, const Frame& b) {
  EXPECT_EQ(a.tick, b.tick);
  EXPECT_EQ(a.round, b.round);
  ASSERT_EQ(a.auras.size(), b.auras.size());
  for (size_t i = 0; i < a.auras.size(); ++i) {
    EXPECT_EQ(a.auras[i], b.auras[i]);
  }
  EXPECT_EQ(a.gone, b.gone);
  ASSERT_EQ(a.graphs.size(), b.graphs.size());
  for (size_t i = 0; i < a.graphs.size(); ++i) ExpectSame(a.graphs[i], b.graphs[i]);
  ASSERT_EQ(a.transfers.size(), b.transfers.size());
  for (size_t i = 0; i < a.transfers.size(); ++i) {
    const Transfer &x = a.transfers[i], &y = b.transfers[i];
    EXPECT_EQ(x.ids, y.ids);
    EXPECT_EQ(x.epochs, y.epochs);
    EXPECT_EQ(x.cause, y.cause);
    EXPECT_EQ(x.state, y.state);
    ASSERT_EQ(x.pending.size(), y.pending.size());
    for (size_t j = 0; j < x.pending.size(); ++j) {
      const Input &p = x.pending[j], &q = y.pending[j];
      EXPECT_TRUE(p.tick == q.tick && p.kind == q.kind && p.body == q.body);
    }
  }
  EXPECT_EQ(a.away, b.away);
  EXPECT_EQ(a.away_gone, b.away_gone);
  EXPECT_EQ(a.welcome, b.welcome);
}

absl::Status Refusal(const v1::Frame& frame) { return DecodeFrame(frame.SerializeAsString(), 0, 1).status(); }

v1::Frame Parsed(const Frame& frame) {
  v1::Frame out;
  EXPECT_TRUE(out.ParseFromString(EncodeFrame(frame)));
  return out;
}

TEST(FrameCodec, FrameSurvivesBitForBit) {
  for (bool predicted : {false, true}) {
    const Frame frame = MakeFrame(predicted);
    const absl::StatusOr<Frame> back = DecodeFrame(EncodeFrame(frame), frame.from, frame.to[0]);
    ASSERT_TRUE(back.ok()) << back.status();
    EXPECT_EQ(back->from, 1);
    EXPECT_EQ(back->to, std::vector<RegionId>{2});
    ExpectSame(frame, *back);
  }
}

TEST(FrameCodec, EncodingDoesNotDependOnTheReceiver) {
  Frame a = MakeFrame(false), b = a;
  b.to = {0, 2};
  EXPECT_EQ(EncodeFrame(a), EncodeFrame(b));
}

TEST(FrameCodec, AuraUpdateCostsAtMostSixtyBytes) {
  for (bool predicted : {false, true}) {
    Frame with, without;
    with.tick = without.tick = 1000000;
    // Ids far apart: the dearest delta.
    for (BodyId id = 1; id <= 100; ++id) with.auras.push_back(MakeAura(id * 0x9E3779B97F4A7C15ull, predicted));
    const double bytes = static_cast<double>(EncodeFrame(with).size() - EncodeFrame(without).size()) / 100;
    EXPECT_LE(bytes, static_cast<double>(kMaxAuraBytes));
    RecordProperty(predicted ? "bytes_predicted" : "bytes", std::to_string(bytes));
    Frame one;
    one.tick = without.tick;
    one.auras.push_back(MakeAura(~0ull / 3, predicted));
    EXPECT_LE(EncodeFrame(one).size() - EncodeFrame(without).size(), kMaxAuraBytes + 8);  // and the columns' headers
  }
}

TEST(FrameCodec, EmptyFrameIsThePhaseAlone) {
  Frame frame;
  frame.tick = 60 * 60 * 24 * 60;  // a day at 60 Hz
  frame.round = 1;
  EXPECT_LE(EncodeFrame(frame).size(), 5u);
}

TEST(FrameCodec, RefusesWhatNoRegionSends) {
  const auto refused = [](const char* field, auto change) {
    v1::Frame frame = Parsed(MakeFrame(true));
    change(&frame);
    const absl::Status s = Refusal(frame);
    EXPECT_EQ(s.code(), absl::StatusCode::kInvalidArgument) << field;
    EXPECT_NE(std::string(s.message()).find(field), std::string::npos) << field << ": " << s.message();
  };
  EXPECT_TRUE(Refusal(Parsed(MakeFrame(true))).ok());
  refused("frame.phase", [](v1::Frame* f) { f->set_phase(7); });
  refused("frame.aura_id", [](v1::Frame* f) { f->set_aura_id(0, 0); });
  refused("frame.aura_box", [](v1::Frame* f) { f->add_aura_box(1); });
  refused("frame.aura_box", [](v1::Frame* f) { f->set_aura_box(0, 1e9f); });
  refused("frame.aura_box", [](v1::Frame* f) { f->set_aura_box(4, std::nanf("")); });
  refused("frame.aura_owner", [](v1::Frame* f) { f->set_aura_owner(0, kMaxRegions + 1); });
  refused("frame.aura_owner", [](v1::Frame* f) { f->add_aura_owner(1); });
  refused("frame.aura_group", [](v1::Frame* f) { f->add_aura_group(1); });
  refused("frame.aura_energy", [](v1::Frame* f) { f->set_aura_energy(0, std::nanf("")); });
  refused("frame.aura_energy", [](v1::Frame* f) { f->add_aura_energy(1); });
  refused("frame.aura_mass", [](v1::Frame* f) { f->set_aura_mass(0, -1); });
  refused("frame.gone_id", [](v1::Frame* f) { f->set_gone_id(0, 0); });
  refused("frame.graph.edge_step", [](v1::Frame* f) { f->mutable_graph(0)->set_edge_step(0, 0); });
  refused("frame.graph.edge_step", [](v1::Frame* f) { f->mutable_graph(0)->add_edge_step(1); });
  refused("frame.graph.of", [](v1::Frame* f) { f->mutable_graph(0)->set_of(kMaxRegions); });
  refused("frame.graph.late_to", [](v1::Frame* f) { f->mutable_graph(0)->set_late_to(0, kMaxRegions); });
  refused("frame.graph.late_to", [](v1::Frame* f) { f->mutable_graph(0)->add_late_to(1); });
  refused("frame.graph.late_id", [](v1::Frame* f) { f->mutable_graph(0)->set_late_id(0, 0); });
  refused("frame.graph.late_box", [](v1::Frame* f) { f->mutable_graph(0)->set_late_box(0, 1e9f); });
  refused("frame.graph.opened", [](v1::Frame* f) { f->mutable_graph(1)->set_opened(0, kMaxRegions); });
  refused("frame.graph.closed", [](v1::Frame* f) { f->mutable_graph(1)->set_closed(0, kMaxRegions); });
  refused("frame.graph.fragment.known", [](v1::Frame* f) { f->mutable_graph(0)->mutable_fragment(0)->clear_known(); });
  refused("frame.graph.fragment.known",
          [](v1::Frame* f) { f->mutable_graph(0)->mutable_fragment(0)->set_known(1, -1); });
  refused("frame.graph.fragment.id", [](v1::Frame* f) { f->mutable_graph(0)->mutable_fragment(0)->set_id(5); });
  refused("frame.graph.fragment.bodies", [](v1::Frame* f) { f->mutable_graph(0)->mutable_fragment(0)->set_bodies(2); });
  refused("frame.graph.fragment.home", [](v1::Frame* f) { f->mutable_graph(0)->mutable_fragment(0)->set_home(1, 0); });
  refused("frame.graph.fragment.mass", [](v1::Frame* f) { f->mutable_graph(0)->mutable_fragment(0)->set_mass(1, -1); });
  refused("frame.graph.fragment.gives_back",
          [](v1::Frame* f) { f->mutable_graph(0)->mutable_fragment(1)->set_gives_back(1u << 31); });
  refused("frame.transfer.id", [](v1::Frame* f) { f->mutable_transfer(0)->set_id(1, 0); });
  refused("frame.transfer.epoch", [](v1::Frame* f) { f->mutable_transfer(0)->add_epoch(1); });
  refused("frame.transfer.cause", [](v1::Frame* f) { f->mutable_transfer(0)->set_cause(4); });
  refused("frame.transfer.state", [](v1::Frame* f) { f->mutable_transfer(0)->clear_state(); });
  refused("frame.transfer.spawn_tick", [](v1::Frame* f) { f->mutable_transfer(0)->add_spawn_tick(1); });
  refused("frame.transfer.spawn_body", [](v1::Frame* f) { f->mutable_transfer(0)->set_spawn_body(0, 0); });
  refused("frame.graph.input.kind", [](v1::Frame* f) { f->mutable_graph(0)->mutable_input(0)->set_kind(7); });
  refused("frame.graph.input.ticks", [](v1::Frame* f) { f->mutable_graph(0)->mutable_input(0)->set_ticks(2); });
  refused("frame.graph.input.point", [](v1::Frame* f) { f->mutable_graph(0)->mutable_input(2)->add_point(1); });
  refused("frame.graph.input.frame", [](v1::Frame* f) { f->mutable_graph(0)->mutable_input(2)->set_frame(3); });
  refused("frame.graph.input.ticks", [](v1::Frame* f) { f->mutable_graph(0)->mutable_input(2)->set_ticks(1 << 20); });
  const auto area = [](v1::Frame* f) { return f->mutable_graph(0)->mutable_input(3)->mutable_area(); };
  refused("frame.graph.input.area.radius", [&](v1::Frame* f) { area(f)->set_radius(0); });
  refused("frame.graph.input.area.radius", [&](v1::Frame* f) { area(f)->set_radius(HUGE_VAL); });
  refused("frame.graph.input.area", [&](v1::Frame* f) { area(f)->set_outward(NAN); });
  refused("frame.graph.input.area.centre", [&](v1::Frame* f) { area(f)->add_centre(1); });
  refused("frame.graph.input.body", [](v1::Frame* f) { f->mutable_graph(0)->mutable_input(3)->set_body(1); });
  const auto spawn = [](v1::Frame* f) { return f->mutable_graph(0)->mutable_input(4)->mutable_spawn(); };
  refused("frame.graph.input.spawn.mass", [&](v1::Frame* f) { spawn(f)->set_mass(0); });
  refused("frame.graph.input.spawn.material", [&](v1::Frame* f) { spawn(f)->add_material(0); });
  refused("frame.graph.input.spawn.orientation", [&](v1::Frame* f) { spawn(f)->set_orientation(3, 9); });
  refused("frame.graph.input.spawn.position", [&](v1::Frame* f) { spawn(f)->set_position(0, NAN); });
  refused("frame.graph.input.spawn.shape.kind", [&](v1::Frame* f) { spawn(f)->mutable_shape()->set_kind(7); });
  refused("frame.graph.input.spawn.shape.children", [&](v1::Frame* f) { spawn(f)->mutable_shape()->clear_children(); });
  refused("frame.graph.input.spawn.shape.radius",
          [&](v1::Frame* f) { spawn(f)->mutable_shape()->mutable_children(0)->mutable_shape()->set_radius(-1); });
  refused("frame.graph.input.spawn.shape.points",
          [&](v1::Frame* f) { spawn(f)->mutable_shape()->mutable_children(1)->mutable_shape()->add_points(1); });
  const auto layout = [](v1::Frame* f) { return f->mutable_graph(0)->mutable_input(5)->mutable_layout(); };
  refused("frame.graph.input.source", [&](v1::Frame* f) { f->mutable_graph(0)->mutable_input(5)->set_source(5); });
  refused("frame.graph.input.source",
          [&](v1::Frame* f) { f->mutable_graph(0)->mutable_input(0)->set_source(kControlSource); });
  refused("frame.graph.input.layout.region", [&](v1::Frame* f) { layout(f)->add_region(1); });
  refused("frame.graph.input.layout.regions[3]", [&](v1::Frame* f) { layout(f)->set_region(12, NAN); });
  refused("none covers", [&](v1::Frame* f) { layout(f)->set_region(1, 0.05); });
  refused("overlaps", [&](v1::Frame* f) { layout(f)->set_region(1, 0.2); });
  refused("frame.graph.input.layout.ranks", [&](v1::Frame* f) { layout(f)->set_rank(0, ~0u); });
  refused("frame.graph.input.layout.rank", [&](v1::Frame* f) {
    for (int i = 0; i < 100; ++i) layout(f)->add_rank(0);
  });
  refused("frame.graph.input.layout.members", [&](v1::Frame* f) { layout(f)->set_member(2, ~0u); });
  refused("frame.graph.input.layout.members", [&](v1::Frame* f) { layout(f)->clear_member(); });
  refused("frame.graph.applied_bodies", [](v1::Frame* f) { f->mutable_graph(0)->set_applied_bodies(0, 0); });
  refused("frame.graph.input", [](v1::Frame* f) { f->mutable_graph(0)->mutable_input(0)->set_source(0); });
  refused("frame.graph.input.linear", [](v1::Frame* f) { f->mutable_graph(0)->mutable_input(0)->set_linear(1, NAN); });
  refused("frame.graph.applied_sequence", [](v1::Frame* f) { f->mutable_graph(0)->add_applied_sequence(1); });
  refused("frame.away_owner", [](v1::Frame* f) { f->set_away_owner(1, kMaxRegions + 1); });
  refused("frame.away_box", [](v1::Frame* f) { f->add_away_box(1); });
  refused("frame.away_gone_id", [](v1::Frame* f) { f->set_away_gone_id(0, 0); });
  refused("does not know", [](v1::Frame* f) {
    f->mutable_transfer(0)->GetReflection()->MutableUnknownFields(f->mutable_transfer(0))->AddVarint(99, 1);
  });
}

TEST(FrameCodec, RefusesMoreThanTheLimits) {
  v1::Frame frame;
  for (size_t i = 0; i <= kMaxTransfers; ++i) frame.add_transfer();
  EXPECT_EQ(Refusal(frame).code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(DecodeFrame(std::string(kMaxFrameBytes + 1, 'x'), 0, 1).status().code(),
            absl::StatusCode::kInvalidArgument);
}

// Whatever decodes must be a frame that encodes and decodes again to the same; nothing may crash or read past the end.
void ExpectHarmless(const std::string& bytes) {
  const absl::StatusOr<Frame> frame = DecodeFrame(bytes, 0, 1);
  if (!frame.ok()) {
    EXPECT_EQ(frame.status().code(), absl::StatusCode::kInvalidArgument);
    EXPECT_EQ(std::string(frame.status().message()).rfind("frame", 0), 0u) << frame.status().message();
    return;
  }
  const absl::StatusOr<Frame> again = DecodeFrame(EncodeFrame(*frame), 0, 1);
  ASSERT_TRUE(again.ok()) << again.status();
  ExpectSame(*frame, *again);
}

TEST(FrameCodec, DamagedBytesAreRefusedOrHarmless) {
  std::mt19937_64 random(1);
  int refused = 0;
  const std::string good[2] = {EncodeFrame(MakeFrame(false)), EncodeFrame(MakeFrame(true))};
  for (int n = 0; n < 20000; ++n) {
    std::string bytes = good[n % 2];
    switch (n / 2 % 4) {
      case 0:
        for (uint64_t flips = 1 + random() % 4; flips > 0; --flips) {
          bytes[random() % bytes.size()] ^= static_cast<char>(1 << random() % 8);
        }
        break;
      case 1:
        bytes.resize(random() % bytes.size());
        break;
      case 2:  // a huge count or length
        bytes.replace(random() % bytes.size(), 1, "\xff\xff\xff\xff\x7f");
        break;
      default:
        bytes.resize(random() % 200);
        for (char& c : bytes) c = static_cast<char>(random());
    }
    ExpectHarmless(bytes);
    refused += !DecodeFrame(bytes, 0, 1).ok();
  }
  EXPECT_GT(refused, 10000);
}

TEST(FrameCodecDeathTest, PendingSpawnStopsTheProcess) {
  Frame frame = MakeFrame(false);
  frame.transfers[0].pending[0].kind = Input::Kind::kImpulse;
  EXPECT_DEATH(EncodeFrame(frame), "in the transfer of body 11");
}

}  // namespace
}  // namespace aureole
