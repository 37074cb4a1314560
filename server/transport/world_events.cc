#include "server/transport/world_events.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include <absl/container/flat_hash_map.h>
#include <absl/container/flat_hash_set.h>
#include <absl/strings/str_cat.h>

namespace aureole {
namespace {

constexpr double kRadiansPerDegree = 3.14159265358979323846 / 180;

using BodyMap = absl::flat_hash_map<BodyId, const BodySpec*>;

BodyMap ById(const std::vector<BodySpec>& bodies) {
  BodyMap map;
  for (const BodySpec& body : bodies) map[body.id] = &body;
  return map;
}

// Why `id` names no dynamic body.
std::string NotDynamic(const World& world, BodyId id) {
  for (const BodySpec& body : world.environment.fixed) {
    if (body.id == id) {
      return absl::StrCat("must be a dynamic body (", id, " is ",
                          body.motion == Motion::kStatic ? "static" : "kinematic", ")");
    }
  }
  return absl::StrCat("must be the id of a body (there is no body ", id, " at that time)");
}

// A point and a direction of the world frame in the frame of the body, or as they are for the world itself.
Vec3 PointIn(const BodySpec* body, const Vec3& p) {
  return body ? Vec3(body->orientation.conjugate() * (p - body->position)) : p;
}
Vec3 DirectionIn(const BodySpec* body, const Vec3& d) { return body ? Vec3(body->orientation.conjugate() * d) : d; }

void ReadHinge(const Path& path, const v1::Joint::Hinge& from, SpecCheck* check, Vec3* axis, JointSpec* out) {
  out->kind = JointKind::kHinge;
  *axis = check->Direction(path / "axis", from.axis());
  if (from.has_lower_degrees() != from.has_upper_degrees()) {
    check->Fail(path / (from.has_lower_degrees() ? "upper_degrees" : "lower_degrees"),
                "must be given when the other limit is");
  }
  if (!from.has_lower_degrees()) return;
  const limits::Range half_turn{-180, 180, "degrees"};
  out->limited = true;
  out->lower = check->In(half_turn, path / "lower_degrees", from.lower_degrees()) * kRadiansPerDegree;
  out->upper = check->In(half_turn, path / "upper_degrees", from.upper_degrees()) * kRadiansPerDegree;
  if (out->lower > out->upper) check->Fail(path / "lower_degrees", "must not be greater than upper_degrees");
}

// What is shared by the joint's repetitions.
struct JointPlan {
  JointSpec joint;
  Vec3 axis = Vec3::UnitZ();  // world frame
};

JointPlan ReadJoint(const Path& path, const v1::Joint& from, SpecCheck* check) {
  JointPlan plan;
  plan.joint.collide = from.collide();
  switch (from.kind_case()) {
    case v1::Joint::kPoint:
      plan.joint.kind = JointKind::kPoint;
      break;
    case v1::Joint::kHinge:
      ReadHinge(path / "hinge", from.hinge(), check, &plan.axis, &plan.joint);
      break;
    case v1::Joint::kFixed:
      plan.joint.kind = JointKind::kFixed;
      break;
    case v1::Joint::KIND_NOT_SET:
      check->Fail(path, "must be given a kind: \"point\": {}, \"hinge\": {...} or \"fixed\": {}");
  }
  return plan;
}

// Ids of the bodies that live while events are read in the order in which they act.
class Living {
 public:
  explicit Living(const World& world) : world_(world) {
    for (const BodySpec& body : world.bodies) ids_.insert(body.id);
  }
  void Check(const Path& path, BodyId id, SpecCheck* check) const {
    if (!ids_.contains(id)) check->Fail(path, NotDynamic(world_, id));
  }
  void Add(BodyId id) { ids_.insert(id); }
  void Remove(BodyId id) { ids_.erase(id); }

 private:
  const World& world_;
  absl::flat_hash_set<BodyId> ids_;
};

void ReadEvent(const Path& path, const v1::Event& from, const Input& at, BodyReader* reader, Living* living,
               std::vector<Input>* out) {
  SpecCheck* check = reader->check;
  Input input = at;
  switch (from.what_case()) {
    case v1::Event::kSpawn: {
      std::vector<BodySpec> bodies;
      reader->Dynamic(path / "spawn", from.spawn(), &bodies);
      input.kind = Input::Kind::kSpawn;
      for (BodySpec& body : bodies) {
        input.body = body.id;
        living->Add(body.id);
        input.spawn = std::make_shared<const BodySpec>(std::move(body));
        out->push_back(input);
      }
      return;
    }
    case v1::Event::kRemove:
      input.kind = Input::Kind::kRemove;
      input.body = from.remove();
      living->Check(path / "remove", input.body, check);
      living->Remove(input.body);
      break;
    case v1::Event::kImpulse:
      input.kind = Input::Kind::kImpulse;
      input.body = from.impulse().body();
      living->Check(path / "impulse" / "body", input.body, check);
      input.linear = check->Vector(limits::kImpulse, path / "impulse" / "linear", from.impulse().linear());
      input.angular = check->Vector(limits::kImpulse, path / "impulse" / "angular", from.impulse().angular());
      break;
    case v1::Event::kVelocity:
      input.kind = Input::Kind::kVelocity;
      input.body = from.velocity().body();
      living->Check(path / "velocity" / "body", input.body, check);
      input.linear = check->Vector(limits::kSpeed, path / "velocity" / "linear", from.velocity().linear());
      input.angular = check->Vector(limits::kSpin, path / "velocity" / "angular", from.velocity().angular());
      break;
    case v1::Event::WHAT_NOT_SET:
      return check->Fail(path, "must be given what happens: spawn, remove, impulse or velocity");
  }
  out->push_back(std::move(input));
}

}  // namespace

void ReadJoints(const v1::WorldSpec& spec, SpecCheck* check, World* world) {
  const BodyMap bodies = ById(world->bodies);
  for (int i = 0; i < spec.joints_size() && check->ok(); ++i) {
    const v1::Joint& from = spec.joints(i);
    const Path path = (Path() / "joints")[i];
    const JointPlan plan = ReadJoint(path, from, check);
    const Vec3 at = check->Position(path / "at", from.at());
    const Vec3 spacing = check->Position(path / "spacing", from.spacing());
    if (from.a() == from.b()) check->Fail(path / "b", "must not be the body that a is");
    const uint64_t repeat = std::max<uint32_t>(1, from.repeat());
    if (repeat > static_cast<uint64_t>(limits::kMaxJoints) - world->joints.size()) {
      check->Fail(path / "repeat", absl::StrCat("must leave the world at most kMaxJoints, ", limits::kMaxJoints));
    }
    for (uint64_t copy = 0; copy < repeat && check->ok(); ++copy) {
      JointSpec joint = plan.joint;
      joint.id = world->joints.size() + 1;
      joint.a = from.a() + copy;
      joint.b = from.b() == 0 ? 0 : from.b() + copy;
      const auto a = bodies.find(joint.a), b = bodies.find(joint.b);
      if (a == bodies.end()) check->Fail(path / "a", NotDynamic(*world, joint.a));
      if (joint.b != 0 && b == bodies.end()) {
        check->Fail(path / "b", NotDynamic(*world, joint.b) + "; leave b out to join a to the world");
      }
      if (!check->ok()) return;
      const BodySpec* on_a = a->second;
      const BodySpec* on_b = joint.b == 0 ? nullptr : b->second;
      const Vec3 point = at + static_cast<double>(copy) * spacing;
      joint.pivot_a = PointIn(on_a, point);
      joint.pivot_b = PointIn(on_b, point);
      joint.axis_a = DirectionIn(on_a, plan.axis);
      joint.axis_b = DirectionIn(on_b, plan.axis);
      // Fixed: the two frames are the world's own, as seen from each body.
      joint.frame_a = on_a->orientation.conjugate();
      joint.frame_b = on_b ? on_b->orientation.conjugate() : Quat::Identity();
      world->joints.push_back(joint);
    }
  }
}

void ReadEvents(const v1::WorldSpec& spec, BodyReader* reader, World* world) {
  SpecCheck* check = reader->check;
  if (spec.events_size() > limits::kMaxEvents) {
    check->Fail(Path() / "events", absl::StrCat("must be at most kMaxEvents, ", limits::kMaxEvents));
  }
  // In the order in which they act: a body must be there when it is named.
  std::vector<std::pair<Tick, int>> order;
  for (int i = 0; i < spec.events_size() && check->ok(); ++i) {
    const int64_t us = check->Microseconds((Path() / "events")[i] / "at", spec.events(i).at(), 0, limits::kMaxTimeUs);
    const int64_t tick_us = world->environment.tick_us;
    order.emplace_back(std::max<Tick>(1, (us + tick_us - 1) / tick_us), i);
  }
  std::sort(order.begin(), order.end());
  Living living(*world);
  for (const auto& [tick, i] : order) {
    if (!check->ok()) return;
    Input at;
    at.tick = tick;
    ReadEvent((Path() / "events")[i], spec.events(i), at, reader, &living, &world->script);
  }
  for (size_t i = 0; i < world->script.size(); ++i) world->script[i].sequence = i + 1;
}

void ReadInjectors(const v1::WorldSpec& spec, Catalogue* catalogue, SpecCheck* check, World* world) {
  if (spec.injectors_size() > limits::kMaxInjectors) {
    check->Fail(Path() / "injectors", absl::StrCat("must be at most kMaxInjectors, ", limits::kMaxInjectors));
  }
  for (int i = 0; i < spec.injectors_size() && check->ok(); ++i) {
    const v1::Injector& from = spec.injectors(i);
    const Path path = (Path() / "injectors")[i];
    Injector out;
    out.rate = check->In(limits::kRate, path / "rate", from.rate());
    if (std::abs(out.rate * 1e3 - std::round(out.rate * 1e3)) > 1e-6) {
      check->Fail(path / "rate", "must be a whole number of thousandths of a body per second");
    }
    out.start = static_cast<double>(check->Microseconds(path / "start", from.start(), 0, limits::kMaxTimeUs)) * 1e-6;
    out.duration =
        static_cast<double>(check->Microseconds(path / "duration", from.duration(), 1, limits::kMaxTimeUs)) * 1e-6;
    if (from.volumes_size() == 0) check->Fail(path / "volumes", "must be at least one");
    for (int v = 0; v < from.volumes_size(); ++v) {
      const v1::Injector::Volume& volume = from.volumes(v);
      const Path at = (path / "volumes")[v];
      const Vec3 min = check->Position(at / "min", volume.min()), max = check->Position(at / "max", volume.max());
      if ((min.array() > max.array()).any()) check->Fail(at / "max", "must not be less than min on any axis");
      const double weight =
          volume.has_weight() ? check->Positive(limits::kWeight, at / "weight", volume.weight()) : 1.0;
      out.volumes.push_back({min, max, weight});
    }
    if (from.kinds_size() == 0) check->Fail(path / "kinds", "must be at least one");
    for (int k = 0; k < from.kinds_size() && check->ok(); ++k) {
      const v1::Injector::Kind& kind = from.kinds(k);
      const Path at = (path / "kinds")[k];
      InjectorShape shape;
      shape.shape = catalogue->Moving(at / "shape", kind.shape());
      shape.mass = catalogue->Mass(at, kind, shape.shape);
      shape.weight = kind.has_weight() ? check->Positive(limits::kWeight, at / "weight", kind.weight()) : 1.0;
      shape.material = catalogue->MaterialOf(at / "material", kind.material());
      shape.ccd = kind.ccd();
      out.shapes.push_back(std::move(shape));
    }
    out.min_velocity = check->Vector(limits::kSpeed, path / "min_velocity", from.min_velocity());
    out.max_velocity = check->Vector(limits::kSpeed, path / "max_velocity", from.max_velocity());
    if ((out.min_velocity.array() > out.max_velocity.array()).any()) {
      check->Fail(path / "max_velocity", "must not be less than min_velocity on any axis");
    }
    out.max_spin = check->In(limits::kSpin, path / "max_spin", from.max_spin());
    out.random_orientation = !from.has_turned() || from.turned();
    world->injectors.push_back(std::move(out));
  }
}

}  // namespace aureole
