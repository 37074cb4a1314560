#include "tests/simulation/scenario.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <numeric>

#include "server/core/check.h"
#include "tests/simulation/random.h"

namespace aureole::sim {
namespace {

constexpr double kSpeed = 32;  // V_t, m/s
constexpr double kPi = 3.14159265358979323846;

Layout MakeLayout(const std::string& name, double width, Random& rng) {
  const double inf = std::numeric_limits<double>::infinity();
  const double w = width;
  absl::StatusOr<Layout> layout = absl::InternalError("");
  if (name == "columns2") layout = Layout::Columns(std::array{0.0});
  if (name == "columns3") layout = Layout::Columns(std::array{-w / 2, w / 2});
  if (name == "columns4") layout = Layout::Columns(std::array{-w, 0.0, w});
  if (name == "tee") layout = Layout::Rectangles({{-inf, 0, -inf, inf}, {0, inf, -inf, 0}, {0, inf, 0, inf}});
  if (name == "grid4") layout = Layout::Grid(std::array{0.0}, std::array{0.0});
  if (name == "grid9") layout = Layout::Grid(std::array{-w / 2, w / 2}, std::array{-w / 2, w / 2});
  if (name == "bricks") layout = Layout::Bricks(std::array{-w / 2, w / 2}, std::array{0.0});
  AUREOLE_CHECK(layout.ok(), "layout %s: %s", name.c_str(), std::string(layout.status().message()).c_str());
  std::vector<int> ranks(layout->size());
  std::iota(ranks.begin(), ranks.end(), 0);
  for (int i = layout->size() - 1; i > 0; --i) std::swap(ranks[i], ranks[rng.Below(i + 1)]);
  AUREOLE_CHECK(layout->SetRanks(ranks).ok(), "ranks");
  return *layout;
}

// Builds bodies that do not overlap at the start.
class Placer {
 public:
  Placer(Random& rng, bool toy) : rng_(rng), toy_(toy) {}

  std::shared_ptr<const Shape> RandomShape(double smallest, double largest) {
    auto s = std::make_shared<Shape>();
    const double r = rng_.In(smallest, largest);
    const int kind = rng_.Below(toy_ ? 2 : 6);
    s->radius = r;
    s->half = {r, rng_.In(smallest, largest), rng_.In(smallest, largest)};
    switch (kind) {
      case 0:
        s->kind = ShapeKind::kSphere;
        break;
      case 1:
        s->kind = ShapeKind::kBox;
        break;
      case 2:
        s->kind = ShapeKind::kCapsule;
        s->half.y() = r * rng_.In(1.2, 2.5);
        break;
      case 3:
        s->kind = ShapeKind::kCylinder;
        break;
      case 4: {
        s->kind = ShapeKind::kHull;
        for (int i = 0; i < 8; ++i) {
          s->points.push_back({(i & 1 ? 1 : -1) * s->half.x() * rng_.In(.7, 1),
                               (i & 2 ? 1 : -1) * s->half.y() * rng_.In(.7, 1),
                               (i & 4 ? 1 : -1) * s->half.z() * rng_.In(.7, 1)});
        }
        break;
      }
      default: {
        s->kind = ShapeKind::kCompound;
        auto a = std::make_shared<Shape>();
        a->kind = ShapeKind::kBox;
        a->half = s->half * 0.6;
        auto b = std::make_shared<Shape>();
        b->kind = ShapeKind::kSphere;
        b->radius = r * 0.6;
        s->children.push_back({{-r * 0.4, 0, 0}, Quat::Identity(), a});
        s->children.push_back({{r * 0.4, 0, 0}, Quat::Identity(), b});
      }
    }
    return s;
  }

  BodySpec Body(std::shared_ptr<const Shape> shape) {
    BodySpec b;
    b.id = next_id_;
    next_id_ += 1 + static_cast<BodyId>(rng_.Below(1000));
    b.shape = std::move(shape);
    b.mass = rng_.In(0.5, 4);
    b.material.friction = rng_.In(0.3, 0.9);
    b.material.restitution = rng_.Chance(0.3) ? rng_.In(0, 0.6) : 0;
    b.material.rolling_friction = rng_.Chance(0.3) ? 0.02 : 0;
    if (!toy_) {
      Quat q(rng_.In(-.5, .5), rng_.In(-.5, .5), rng_.In(-.5, .5), rng_.In(.1, 1));
      b.orientation = q.normalized();
    }
    return b;
  }

  static double Radius(const Shape& s) {
    double r = std::max({s.radius, s.half.x(), s.half.y(), s.half.z()});
    if (s.kind != ShapeKind::kSphere) r = s.half.norm() * 1.001;
    if (s.kind == ShapeKind::kCompound) r = s.half.norm() + s.radius;
    return r;
  }

  // Places the body by `where` until it is `gap` away from all others; false when it found no room.
  bool Place(BodySpec* b, double gap, const std::function<Vec3(int)>& where) {
    const double r = toy_ ? std::max({b->shape->radius, b->shape->half.maxCoeff()}) : Radius(*b->shape);
    for (int attempt = 0; attempt < 200; ++attempt) {
      b->position = where(attempt);
      if (!toy_) b->position.y() = std::max(b->position.y(), r + 0.03);
      const Vec3 half =
          toy_ ? (b->shape->kind == ShapeKind::kSphere ? Vec3::Constant(b->shape->radius).eval() : b->shape->half)
               : Vec3::Constant(r + 0.03).eval();
      const Box box{b->position - half, b->position + half};
      if (std::all_of(boxes_.begin(), boxes_.end(), [&](const Box& o) { return Gap(o, box) >= gap; })) {
        boxes_.push_back(box);
        return true;
      }
    }
    return false;
  }

 private:
  Random& rng_;
  bool toy_;
  BodyId next_id_ = 1;
  std::vector<Box> boxes_;
};

Vec3 Flat(Random& rng, double speed) {
  const double a = rng.In(0, 2 * kPi);
  return {speed * std::cos(a), 0, speed * std::sin(a)};
}

struct Builder {
  World& world;
  Random& rng;
  bool toy;
  double width;
  Placer placer;
  double top_speed;  // of what a scene throws
  std::optional<Vec3> stirred;

  Builder(World& w, Random& r, bool t, double wid)
      : world(w),
        rng(r),
        toy(t),
        width(wid),
        placer(r, t),
        top_speed(w.exchange.k == 0 && r.Chance(0.3) ? 400 : kSpeed) {}

  double Spread() const { return world.layout.size() > 2 ? width * 0.8 : 4; }
  // Somewhere near a border, half of the time near a corner if the layout has any.
  Vec3 NearBorder(double off) {
    const Rect& r = world.layout.rect(rng.Below(world.layout.size()));
    const Vec3 corner(std::isfinite(r.min_x) ? r.min_x : r.max_x, 0, std::isfinite(r.min_z) ? r.min_z : r.max_z);
    if (corner.allFinite() && rng.Chance(0.5)) {
      return corner + Vec3(rng.In(-off, off), toy ? 0 : rng.In(0.3, 2.5), rng.In(-off, off));
    }
    auto edge = [this](double lo, double hi) {
      if (std::isinf(lo) && std::isinf(hi)) return rng.In(-4, 4);
      if (std::isinf(lo)) return hi;
      if (std::isinf(hi)) return lo;
      return rng.Chance(0.5) ? lo : hi;
    };
    double x = edge(r.min_x, r.max_x), z = edge(r.min_z, r.max_z);
    if (rng.Chance(0.3) && std::isfinite(r.min_z + r.max_z)) z = rng.In(r.min_z, r.max_z);
    return {x + rng.In(-off, off), toy ? 0 : rng.In(0.3, 2.5), z + rng.In(-off, off)};
  }
  void Add(BodySpec b) { world.bodies.push_back(std::move(b)); }

  // Bodies that all cross one spot at about the same time.
  void Burst(int n) {
    const Vec3 spot = NearBorder(0.6);
    for (int i = 0; i < n; ++i) {
      BodySpec b = placer.Body(placer.RandomShape(0.1, rng.Chance(0.8) ? 0.3 : 1.2));
      const double speed = kSpeed * (rng.Chance(0.8) ? 0.999 : rng.In(0.3, 1));
      b.velocity = rng.Chance(0.4) ? Flat(rng, 0) : Flat(rng, speed);
      if (b.velocity.norm() == 0) {
        const int q = rng.Below(4);
        b.velocity = Vec3(q == 0 ? speed : q == 1 ? -speed : 0, 0, q == 2 ? speed : q == 3 ? -speed : 0);
      }
      const double t = rng.In(10, 20) * world.environment.dt();
      const double w = rng.Chance(0.5) ? 0.6 : 3;
      const bool placed = placer.Place(&b, 0.01, [&](int) -> Vec3 {
        return spot + Vec3(rng.In(-w, w), toy ? 0 : rng.In(0, 0.5), rng.In(-w, w)) - b.velocity * t;
      });
      if (placed) Add(b);
    }
  }

  // Pairs that meet head-on at full speed near a border: the narrowest test of a margin. Some of the partners appear
  // only when the other one is almost there.
  void Duels(int n, Tick ticks) {
    for (int i = 0; i < n; ++i) {
      const double z = 6.0 * (i - n / 2), speed = kSpeed * (1 - 1e-9), dt = world.environment.dt();
      const bool spawned = rng.Chance(0.4);
      auto shape = std::make_shared<Shape>();
      shape->radius = 0.1;
      BodySpec a = placer.Body(shape), b = placer.Body(shape);
      const double meet = rng.In(-1.5, 1.5), t = rng.In(12, 30) * dt, y = toy ? 0 : 0.5;
      a.velocity = {speed, 0, 0};
      b.velocity = {-speed, 0, 0};
      if (rng.Chance(0.5)) std::swap(a.velocity, b.velocity);
      a.position = Vec3(meet, y, z) - a.velocity * t - a.velocity.normalized() * 0.1;
      b.position = Vec3(meet, y, z) - b.velocity * t - b.velocity.normalized() * 0.1;
      Add(a);
      if (!spawned) {
        Add(b);
        continue;
      }
      auto late = std::make_shared<BodySpec>(b);
      Input in;
      in.kind = Input::Kind::kSpawn;
      in.tick = 8 * world.exchange.k + 1 + rng.Below(static_cast<int>(ticks / 3));
      // Less than a tick before they meet, wherever the first one is then.
      const double before = rng.In(0, 1) * dt, travelled = static_cast<double>(in.tick - 1) * dt;
      late->position =
          a.position + a.velocity * (travelled + before) + a.velocity.normalized() * 0.2 - b.velocity * before;
      const double shift = late->position.x() - meet;  // so that it happens near the border
      late->position.x() -= shift;
      world.bodies.back().position.x() -= shift;
      in.body = late->id;
      in.spawn = late;
      world.script.push_back(in);
    }
  }

  // A nearly touching heap on a border.
  void Heap(int n) {
    const Vec3 centre = NearBorder(0.3);
    double w = std::sqrt(n) * 0.45;
    for (int i = 0; i < n; ++i) {
      BodySpec b = placer.Body(placer.RandomShape(0.1, 0.5));
      const bool placed = placer.Place(&b, 0.001, [&](int attempt) -> Vec3 {
        if (attempt % 40 == 39) w *= 1.1;
        return {centre.x() + rng.In(-w, w), toy ? 0 : rng.In(0.3, 0.3 + w), centre.z() + rng.In(-w, w)};
      });
      if (!placed) continue;
      if (toy) b.velocity = Flat(rng, kSpeed * rng.Unit() * rng.Unit());
      if (toy && rng.Chance(0.2)) Sleep(&b);
      Add(b);
    }
  }

  // A row of nearly touching bodies across a border, struck at its end: the speed passes through in one tick.
  void Cradle(int n) {
    double x = NearBorder(0).x() - rng.In(0.5, 3);
    const double z = NearBorder(0.1).z();
    for (int i = 0; i < n; ++i) {
      auto shape = std::make_shared<Shape>();
      shape->radius = 0.3;
      BodySpec b = placer.Body(shape);
      if (toy) b.mass = 1;
      const double y = toy ? 0 : 0.3;
      if (i == 0) {
        b.velocity = {kSpeed * rng.In(0.4, 0.999), 0, 0};
        b.position = {x - 0.3 - b.velocity.x() * world.environment.dt() * rng.In(4, 12), y, z};
      } else if (i < n - 1) {
        x += 0.3;
        b.position = {x, y, z + rng.In(-.05, .05)};
        x += 0.3 + (rng.Chance(0.5) ? (toy ? -0.001 : 0.001) : rng.In(0, 0.03));
        if (rng.Chance(0.5)) Sleep(&b);
      } else {
        b.position = {x + rng.In(0.1, 3) + 0.3, y, z};
        if (rng.Chance(0.5)) {
          Sleep(&b);
        } else {
          b.velocity = {-rng.In(0, 0.3) * kSpeed, 0, 0};
        }
      }
      Add(b);
    }
  }

  // Scattered bodies of all sizes and speeds, some asleep.
  void Scatter(int n) {
    const double s = Spread() + 4;
    for (int i = 0; i < n; ++i) {
      BodySpec b = placer.Body(placer.RandomShape(0.1, rng.Chance(0.5) ? 0.3 : 1.5));
      if (!placer.Place(&b, 0.01, [&](int) -> Vec3 {
            return {rng.In(-s, s), toy ? 0 : rng.In(0.5, 4), rng.In(-7, 7)};
          }))
        continue;
      b.velocity = Flat(rng, kSpeed * rng.In(0.1, 0.999));
      if (rng.Chance(0.25)) Sleep(&b);
      Add(b);
    }
  }

  // Slow groups that drift over borders and back: islands.
  void Drift(int n) {
    for (int g = 0; g < n; g += 3) {
      const Vec3 at = NearBorder(2);
      const Vec3 velocity = Flat(rng, rng.In(1, 8));
      for (int i = 0; i < 3; ++i) {
        BodySpec b = placer.Body(placer.RandomShape(0.15, 0.4));
        if (!placer.Place(&b, 0.01, [&](int) -> Vec3 { return at + Vec3(rng.In(-1, 1), 0, rng.In(-1, 1)); })) continue;
        b.velocity = velocity;
        Add(b);
      }
    }
  }

  // A loose crowd along a border that is driven to and fro over it, so that touching bodies change owner all the time.
  void Stir(int n) {
    const Vec3 centre = NearBorder(0.2);
    for (int i = 0; i < n; ++i) {
      BodySpec b = placer.Body(placer.RandomShape(0.15, 0.4));
      if (!placer.Place(&b, 0.005, [&](int) -> Vec3 {
            return centre + Vec3(rng.In(-4, 4), toy ? 0 : rng.In(0, 1), rng.In(-10, 10));
          })) {
        continue;
      }
      b.material.rolling_friction = 0.02;
      Add(b);
    }
    stirred = centre;
  }

  void Sleep(BodySpec* b) const {
    b->velocity = Vec3::Zero();
    b->asleep = toy;  // a body of the real engine falls asleep where it rests
  }

  void AddJoints(int n) {
    for (int i = 0; i < n && 2 * i + 1 < static_cast<int>(world.bodies.size()); ++i) {
      BodySpec &a = world.bodies[2 * i], &b = world.bodies[2 * i + 1];
      JointSpec j;
      j.id = static_cast<JointId>(i + 1);
      j.kind = toy ? JointKind::kPoint : static_cast<JointKind>(1 + rng.Below(3));
      j.a = a.id;
      j.b = b.id;
      const double d = Placer::Radius(*a.shape) + Placer::Radius(*b.shape) + 0.1;
      b.position = a.position + Vec3(d, 0, 0);
      b.orientation = a.orientation = Quat::Identity();
      b.velocity = a.velocity;
      b.asleep = a.asleep;
      j.pivot_a = {d / 2, 0, 0};
      j.pivot_b = {-d / 2, 0, 0};
      world.joints.push_back(j);
    }
    std::sort(world.bodies.begin(), world.bodies.end(),
              [](const BodySpec& x, const BodySpec& y) { return x.id < y.id; });
  }

  // Bodies that appear at any place, occupied or not.
  void AddSpawns(int n, Tick ticks) {
    for (int i = 0; i < n; ++i) {
      auto b = std::make_shared<BodySpec>(placer.Body(placer.RandomShape(0.1, 0.5)));
      b->id += 1000000;
      b->position = NearBorder(1.5);
      if (!toy) b->position.y() += 1;
      b->velocity = Flat(rng, kSpeed * rng.Unit() * 0.9);
      Input in;
      in.kind = Input::Kind::kSpawn;
      in.tick = 1 + rng.Below(static_cast<int>(ticks / 2));
      in.body = b->id;
      in.spawn = std::move(b);
      world.script.push_back(in);
    }
  }

  void AddRemovals(int n, Tick ticks) {
    for (int i = 0; i < n && !world.bodies.empty(); ++i) {
      const BodySpec& b = world.bodies[rng.Below(static_cast<int>(world.bodies.size()))];
      const bool jointed = std::any_of(world.joints.begin(), world.joints.end(),
                                       [&](const JointSpec& j) { return j.a == b.id || j.b == b.id; });
      if (jointed) continue;
      Input in;
      in.kind = Input::Kind::kRemove;
      in.tick = ticks / 3 + rng.Below(static_cast<int>(ticks / 2));
      in.body = b.id;
      world.script.push_back(in);
    }
  }
};

void OverrideMargins(const ScenarioOptions& options, World* world) {
  Margins m = MarginsFor(*world);
  for (const auto& [name, value] : options.margin_overrides) {
    if (name == "predict") m.predict = value;
    if (name == "give_back") m.give_back = value;
    if (name == "project") m.project = value;
    if (name == "spawn_notice") m.spawn_notice = static_cast<int>(value);
    if (name == "horizon") m.horizon = static_cast<int>(value);
  }
  world->exchange.margins = m;
}

void SortScript(World* world) {
  std::stable_sort(world->script.begin(), world->script.end(),
                   [](const Input& x, const Input& y) { return x.tick < y.tick; });
  uint64_t sequence = 0;
  for (Input& i : world->script) i.sequence = ++sequence;
}

// Throws bodies at each other by what the undivided run shows, and appends these impulses to the script.
void Aim(Scenario* scenario, double rate, double top_speed, const std::optional<Vec3>& stirred, Random& rng,
         const EngineFactory& make_engine) {
  World& world = scenario->world;
  std::unique_ptr<Engine> engine = make_engine(world.environment);
  for (const BodySpec& b : world.bodies) engine->Spawn(b);
  for (const JointSpec& j : world.joints) engine->Join(j);
  std::vector<Input> aimed;
  for (Tick n = 1; n <= scenario->ticks; ++n) {
    std::vector<Input> inputs;
    ScriptedInputs(world, n, &inputs);
    const std::vector<BodyId> ids = engine->Ids();
    for (BodyId id : ids) {
      if (ids.size() < 2 || !rng.Chance(rate)) continue;
      const BodyView me = engine->View(id);
      const BodyView other = engine->View(ids[rng.Below(static_cast<int>(ids.size()))]);
      const double speed = top_speed * (rng.Chance(0.5) ? 0.999 : rng.Unit());
      Vec3 velocity = Flat(rng, speed);
      if (other.id != id && rng.Chance(0.7)) {
        const Vec3 to = other.centre - me.centre;
        velocity = to.normalized() * speed * (rng.Chance(0.15) ? -1 : 1);
        if (rng.Chance(0.3)) {  // along one axis: the fastest way to close a box gap
          const bool x = std::fabs(to.x()) > std::fabs(to.z());
          velocity = x ? Vec3(to.x() > 0 ? speed : -speed, 0, 0) : Vec3(0, 0, to.z() > 0 ? speed : -speed);
        }
      }
      if (stirred) {
        const double side = (n / 50 + static_cast<Tick>(id)) % 2 == 0 ? 2.5 : -2.5;
        const Vec3 to = *stirred + Vec3(side + rng.In(-1, 1), 0, rng.In(-8, 8)) - me.centre;
        velocity = Vec3(to.x() * 2, 0, to.z() * 0.3);
        if (velocity.norm() > 12) velocity *= 12 / velocity.norm();
        velocity.y() = scenario->world.environment.gravity.y() < 0 ? rng.In(0, 2) : 0;
      }
      Input in;
      in.kind = Input::Kind::kVelocity;
      in.tick = n;
      in.sequence = 1000000;
      in.body = id;
      in.linear = velocity;
      aimed.push_back(in);
      inputs.push_back(in);
    }
    for (const Input& i : inputs) {
      if (i.kind == Input::Kind::kSpawn || engine->Contains(i.body)) engine->Apply(i);
    }
    engine->Step(n);
  }
  world.script.insert(world.script.end(), aimed.begin(), aimed.end());
  SortScript(&world);
}

// Makes an impulse at body `b` any other kind of live input.
void Vary(const World& world, const BodySpec& b, Input* in, Random& rng) {
  const Vec3 near = b.position + Flat(rng, rng.In(0, 3));
  switch (rng.Below(8)) {
    case 0:  // a force
      in->ticks = 2 + rng.Below(30);
      in->linear /= static_cast<double>(in->ticks);
      break;
    case 1:
      in->kind = Input::Kind::kVelocityChange;
      in->linear /= b.mass;
      break;
    case 2:
      in->frame = rng.Chance(0.5) ? Input::Frame::kWorld : Input::Frame::kBody;
      in->point = in->frame == Input::Frame::kWorld ? near : Vec3(Flat(rng, rng.In(0, 0.5)));
      in->linear *= 0.1;
      break;
    case 3:
    case 4:  // an explosion
      in->body = 0;
      in->kind = rng.Chance(0.5) ? Input::Kind::kVelocityChange : Input::Kind::kImpulse;
      in->area = {near, rng.In(1, 6), (in->kind == Input::Kind::kImpulse ? b.mass : 1) * rng.In(-5, 20),
                  rng.Chance(0.5)};
      in->linear = Vec3::Zero();
      in->ticks = in->kind == Input::Kind::kImpulse && rng.Chance(0.3) ? 5 : 1;
      break;
    case 5: {  // on top of another body, or next to it
      in->kind = Input::Kind::kSpawn;
      in->body = 0;
      auto spawn = std::make_shared<BodySpec>(world.bodies[rng.Below(static_cast<int>(world.bodies.size()))]);
      spawn->id = 0;
      spawn->position = near;
      spawn->asleep = false;
      spawn->velocity = Flat(rng, kSpeed * rng.Unit() * 0.9);
      in->spawn = std::move(spawn);
      break;
    }
    case 6:
      if (std::none_of(world.joints.begin(), world.joints.end(),
                       [&b](const JointSpec& j) { return j.a == b.id || j.b == b.id; })) {
        in->kind = Input::Kind::kRemove;
      }
      break;
    default:
      break;
  }
}

void AddLive(Scenario* s, int n, Random& rng) {
  for (int i = 0; i < n && !s->world.bodies.empty(); ++i) {
    Input in;
    in.kind = Input::Kind::kImpulse;
    in.tick = 2 + rng.Below(static_cast<int>(s->ticks * 2 / 3));  // offered then
    in.source = 1 + static_cast<uint64_t>(i % 3);
    const BodySpec& b = s->world.bodies[rng.Below(static_cast<int>(s->world.bodies.size()))];
    in.body = b.id;
    in.linear = Flat(rng, kSpeed * rng.Unit() * b.mass);
    s->live.push_back(in);
    Vary(s->world, b, &s->live.back(), rng);
  }
  std::stable_sort(s->live.begin(), s->live.end(), [](const Input& x, const Input& y) { return x.tick < y.tick; });
  std::map<uint64_t, uint64_t> sequences;
  for (Input& in : s->live) in.sequence = ++sequences[in.source];
}

}  // namespace

const std::vector<std::string>& Scenes() {
  static const std::vector<std::string> names{"burst", "heap", "cradle", "scatter", "drift", "duels", "stir"};
  return names;
}

const std::vector<std::string>& Layouts() {
  static const std::vector<std::string> names{"columns2", "columns3", "columns4", "tee", "grid4", "bricks", "grid9"};
  return names;
}

Scenario MakeScenario(uint64_t seed, const ScenarioOptions& options, const EngineFactory& make_engine) {
  Random rng(seed);
  const std::string layout_name = options.layout.value_or(Layouts()[rng.Below(static_cast<int>(Layouts().size()))]);
  const double width = rng.Chance(0.5) ? 4 : 12;
  World world(MakeLayout(layout_name, width, rng));
  world.seed = seed;
  world.environment.gravity = options.toy ? Vec3::Zero() : Vec3(0, -9.81, 0);
  if (!options.toy) {
    auto plane = std::make_shared<Shape>();
    plane->kind = ShapeKind::kPlane;
    BodySpec floor;
    floor.id = uint64_t{1} << 60;
    floor.motion = Motion::kStatic;
    floor.shape = plane;
    world.environment.fixed.push_back(floor);
  }
  const int k = rng.Below(8);
  world.exchange.k = options.k.value_or(k < 5 ? 0 : k - 4);
  const bool reach = rng.Chance(0.5);
  world.exchange.policy = options.policy.value_or(reach ? AuraPolicy::kReach : AuraPolicy::kTolerance);
  // The toy's solver pushes nothing, but its memory of contacts adds a little energy.
  world.exchange.recovery = options.toy ? (world.exchange.policy == AuraPolicy::kReach ? 0.02 : 0) : 0.05;
  if (!options.returns) world.exchange.dwell = 1 << 30;
  world.tolerances.speed = kSpeed;
  if (!options.margin_overrides.empty() && world.exchange.k > 0) OverrideMargins(options, &world);
  world.environment.speed_limit = world.exchange.k == 0 ? 0 : kSpeed;
  world.name = "seed " + std::to_string(seed);

  Scenario s(std::move(world));
  s.layout = layout_name;
  // Most worlds are stirred crowds: an easy world is no proof.
  const bool stir = rng.Chance(0.7);
  s.scene = options.scene.value_or(stir ? "stir" : Scenes()[rng.Below(static_cast<int>(Scenes().size()))]);
  s.ticks = options.toy ? 60 + rng.Below(100) : 150 + rng.Below(100);
  Builder build(s.world, rng, options.toy, width);
  const int size = options.toy ? 1 + rng.Below(3) : 3;
  if (s.scene == "burst") build.Burst(size * (4 + rng.Below(6)));
  if (s.scene == "duels") build.Duels(6, s.ticks);
  if (s.scene == "heap") build.Heap(size * (8 + rng.Below(16)));
  if (s.scene == "cradle") build.Cradle(4 + size * rng.Below(5));
  if (s.scene == "scatter") build.Scatter(size * (5 + rng.Below(8)));
  if (s.scene == "stir") {
    build.Stir(options.toy ? 15 + rng.Below(30) : 40 + rng.Below(60));
    s.ticks = options.toy ? 150 : 800;
  }
  if (s.scene == "drift") build.Drift(size * (6 + rng.Below(9)));
  if (build.stirred) {
    build.AddJoints(static_cast<int>(s.world.bodies.size()) / 4);
  } else if (rng.Chance(0.4)) {
    build.AddJoints(1 + rng.Below(2));
  }
  if (rng.Chance(0.4)) build.AddSpawns(1 + rng.Below(size * 4), s.ticks);
  if (rng.Chance(0.2)) build.AddRemovals(1 + rng.Below(2), s.ticks);
  SortScript(&s.world);
  const double rate = s.scene == "drift"                      ? 0.01
                      : s.scene == "duels" || rng.Chance(0.3) ? 0
                      : rng.Chance(0.5)                       ? 0.02
                                                              : 0.12;
  Aim(&s, build.stirred ? 0.12 : options.toy ? rate : rate / 4, build.top_speed, build.stirred, rng, make_engine);
  if (rng.Chance(0.3)) AddLive(&s, 1 + rng.Below(15), rng);
  return s;
}

}  // namespace aureole::sim
