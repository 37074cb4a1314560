#include "server/transport/world_bodies.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <utility>

#include <absl/strings/str_cat.h>

namespace aureole {
namespace {

// Copies along each axis, at least 1.
struct Counts {
  explicit Counts(const v1::Array& a)
      : x(std::max<int64_t>(1, a.x())), y(std::max<int64_t>(1, a.y())), z(std::max<int64_t>(1, a.z())) {}
  // Saturated just above the limit, so that the product cannot overflow.
  int64_t all() const {
    const int64_t most = limits::kMaxBodies + 1;
    return std::min(most, std::min(most, std::min(most, x) * std::min(most, y)) * std::min(most, z));
  }
  int64_t x, y, z;
};

}  // namespace

void BodyIds::Claim(const Path& path, BodyId first, int64_t count) {
  if (first == 0) return;
  if (first > limits::kMaxGivenId - static_cast<BodyId>(count)) {
    return check_->Fail(path / "id", absl::StrCat("must be at most kMaxGivenId, ", limits::kMaxGivenId));
  }
  for (BodyId id = first; id < first + static_cast<BodyId>(count) && check_->ok(); ++id) {
    const auto [it, inserted] = given_.try_emplace(id, path.str());
    if (!inserted) {
      check_->Fail(path / "id", absl::StrCat("must be used once: ", id, " is an id of ", it->second, " already"));
    }
  }
}

BodyId BodyIds::For(BodyId given, int64_t copy) {
  if (given != 0) return given + static_cast<BodyId>(copy);
  while (given_.contains(next_)) ++next_;
  return next_++;
}

BodyReader::BodyReader(const v1::WorldSpec& spec, SpecCheck* c) : check(c), catalogue(spec, c), ids(c) {
  const auto claim = [&](const Path& path, const v1::Body& body) {
    const int64_t copies = Counts(body.array()).all();
    bodies += copies;
    if (bodies > limits::kMaxBodies) {
      c->Fail(copies > 1 ? path / "array" : path,
              absl::StrCat("must leave the world at most kMaxBodies, ", limits::kMaxBodies, ", bodies"));
    }
    if (!c->ok()) return;
    ids.Claim(path, body.id(), copies);
  };
  for (int i = 0; i < spec.bodies_size(); ++i) claim((Path() / "bodies")[i], spec.bodies(i));
  for (int i = 0; i < spec.events_size(); ++i) {
    if (spec.events(i).has_spawn()) claim((Path() / "events")[i] / "spawn", spec.events(i).spawn());
  }
  for (int i = 0; i < spec.movers_size(); ++i) ids.Claim((Path() / "movers")[i], spec.movers(i).id(), 1);
  for (int i = 0; i < spec.statics_size(); ++i) ids.Claim((Path() / "statics")[i], spec.statics(i).id(), 1);
}

void BodyReader::Dynamic(const Path& path, const v1::Body& from, std::vector<BodySpec>* out) {
  if (!check->ok()) return;
  BodySpec body;
  body.shape = catalogue.Moving(path / "shape", from.shape());
  body.mass = catalogue.Mass(path, from, body.shape);
  body.position = check->Position(path / "position", from.position());
  body.orientation = check->Orientation(path, from);
  body.velocity = check->Vector(limits::kSpeed, path / "velocity", from.velocity());
  body.angular_velocity = check->Vector(limits::kSpin, path / "angular_velocity", from.angular_velocity());
  body.material = catalogue.MaterialOf(path / "material", from.material());
  body.ccd = from.ccd();
  body.asleep = from.asleep();
  if (body.asleep && (!body.velocity.isZero(0) || !body.angular_velocity.isZero(0))) {
    check->Fail(path / "asleep", "must not be set for a body that moves; leave out its velocities");
  }

  const Path array = path / "array";
  const Counts n(from.array());
  const Vec3 spacing = check->Position(array / "spacing", from.array().spacing());
  const Vec3 stagger = check->Position(array / "stagger", from.array().stagger());
  const int64_t along[3] = {n.x, n.y, n.z};
  static constexpr const char* kAxis[3] = {"x", "y", "z"};
  for (int axis = 0; axis < 3; ++axis) {
    if (along[axis] > 1 && spacing[axis] == 0) {
      check->Fail(array / "spacing" / kAxis[axis], "must not be 0: the copies would stand in each other");
    }
  }
  if (!check->ok()) return;

  const Vec3 first = body.position;
  int64_t copy = 0;
  for (int64_t y = 0; y < n.y; ++y) {
    for (int64_t z = 0; z < n.z; ++z) {
      for (int64_t x = 0; x < n.x; ++x) {
        const Vec3 steps(static_cast<double>(x), static_cast<double>(y), static_cast<double>(z));
        body.id = ids.For(from.id(), copy++);
        body.position = first + steps.cwiseProduct(spacing) + (y % 2 == 1 ? stagger : Vec3(Vec3::Zero()));
        out->push_back(body);
      }
    }
  }
  if (!(out->back().position.cwiseAbs().maxCoeff() <= limits::kCoordinate.max)) {
    check->Fail(array, absl::StrCat("must stay within ", limits::kCoordinate.max, " m of the origin"));
  }
}

void BodyReader::Kinematic(const Path& path, const v1::Mover& from, std::vector<BodySpec>* out) {
  if (!check->ok()) return;
  BodySpec body;
  body.id = ids.For(from.id(), 0);
  body.motion = Motion::kKinematic;
  body.shape = catalogue.Moving(path / "shape", from.shape());
  body.material = catalogue.MaterialOf(path / "material", from.material());

  const Path keys = path / "keys";
  if (from.keys_size() < 1 || from.keys_size() > limits::kMaxScriptKeys) {
    check->Fail(keys, absl::StrCat("must be 1 to ", limits::kMaxScriptKeys, " keys (are ", from.keys_size(),
                                   "); the limit is kMaxScriptKeys"));
  }
  Script script;
  int64_t last_us = -1;
  for (int i = 0; i < from.keys_size() && check->ok(); ++i) {
    const v1::Mover::Key& key = from.keys(i);
    const int64_t time_us = check->Microseconds(keys[i] / "time", key.time(), 0, limits::kMaxTimeUs);
    if (time_us <= last_us) check->Fail(keys[i] / "time", "must be later than that of the key before it");
    last_us = time_us;
    script.keys.push_back({static_cast<double>(time_us) * 1e-6, check->Position(keys[i] / "position", key.position()),
                           check->Orientation(keys[i], key)});
  }
  if (from.has_period()) {
    const int64_t period_us = check->Microseconds(path / "period", from.period(), 1, limits::kMaxTimeUs);
    if (period_us < last_us) check->Fail(path / "period", "must not end before the last key");
    script.period = static_cast<double>(period_us) * 1e-6;
  }
  if (!check->ok()) return;
  body.position = script.keys[0].position;
  body.orientation = script.keys[0].orientation;
  body.script = std::make_shared<const Script>(std::move(script));
  out->push_back(std::move(body));
}

void BodyReader::Static(const Path& path, const v1::StaticBody& from, std::vector<BodySpec>* out) {
  if (!check->ok()) return;
  BodySpec body;
  body.id = ids.For(from.id(), 0);
  body.motion = Motion::kStatic;
  body.shape = catalogue.Any(path / "shape", from.shape());
  body.material = catalogue.MaterialOf(path / "material", from.material());
  body.position = check->Position(path / "position", from.position());
  body.orientation = check->Orientation(path, from);
  out->push_back(std::move(body));
}

}  // namespace aureole
