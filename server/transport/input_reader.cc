#include "server/transport/input_reader.h"

#include <algorithm>
#include <cmath>

namespace aureole {
namespace {

constexpr int64_t kMaxForceUs = 60'000'000;

// What a push is made of.
struct Parts {
  explicit Parts(const v1::Impulse& i)
      : impulse(i.has_impulse() || i.has_torque_impulse()),
        change(i.has_velocity_change() || i.has_spin_change()),
        force(i.has_force() || i.has_torque()) {}
  int given() const { return int{impulse} + int{change} + int{force}; }
  bool impulse, change, force;
};

void ReadTarget(const Path& path, const v1::Impulse& from, SpecCheck* check, Input* out) {
  out->body = from.body();
  if (!from.has_sphere()) {
    if (from.body() == 0) check->Fail(path / "body", "must be given, and not be 0; or give a sphere", v1::MISSING);
    return;
  }
  if (from.body() != 0) check->Fail(path / "sphere", "is given beside body; give only one", v1::CONFLICT);
  const Path sphere = path / "sphere";
  out->area.centre = check->Position(sphere / "centre", from.sphere().centre());
  out->area.radius = check->Positive(limits::kSize, sphere / "radius", from.sphere().radius());
  out->area.outward =
      check->In({-limits::kImpulse.max, limits::kImpulse.max, ""}, sphere / "outward", from.sphere().outward());
  out->area.fades = from.sphere().fades();
}

void ReadPoint(const Path& path, const v1::Impulse& from, const Parts& parts, SpecCheck* check, Input* out) {
  if (!from.has_at_point() && !from.has_at_body_point()) return;
  const char* field = from.has_at_point() ? "at_point" : "at_body_point";
  if (from.has_at_point() && from.has_at_body_point()) {
    check->Fail(path / "at_body_point", "is given beside at_point; give only one", v1::CONFLICT);
  }
  if (parts.change) {
    check->Fail(path / field, "has no meaning for a change of velocity; leave it out", v1::CONFLICT);
  }
  out->frame = from.has_at_point() ? Input::Frame::kWorld : Input::Frame::kBody;
  out->point = check->Position(path / field, from.has_at_point() ? from.at_point() : from.at_body_point());
}

void ReadForce(const Path& path, const v1::Impulse& from, int64_t tick_us, SpecCheck* check, Input* out) {
  if (!from.has_duration()) {
    return check->Fail(path / "duration", "must be given with a force; an impulse needs none", v1::MISSING);
  }
  const int64_t us = check->Microseconds(path / "duration", from.duration(), 1, kMaxForceUs);
  out->ticks = std::max<Tick>(1, (us + tick_us / 2) / tick_us);
  const double dt = static_cast<double>(tick_us) * 1e-6;
  out->linear = check->Vector(limits::kForce, path / "force", from.force()) * dt;
  out->angular = check->Vector(limits::kForce, path / "torque", from.torque()) * dt;
  out->area.outward *= dt;
}

}  // namespace

ClientLimits ReadClientLimits(const v1::ClientLimits& spec, SpecCheck* check) {
  ClientLimits out;
  const Path path = Path() / "client_limits";
  if (spec.has_impulse()) out.impulse = check->In(limits::kImpulse, path / "impulse", spec.impulse());
  if (spec.has_velocity_change()) {
    out.velocity_change = check->In(limits::kSpeed, path / "velocity_change", spec.velocity_change());
  }
  if (spec.has_rate()) out.rate = check->In(limits::kInputRate, path / "rate", spec.rate());
  return out;
}

Input ReadImpulse(const Path& path, const v1::Impulse& from, int64_t tick_us, SpecCheck* check) {
  Input out;
  out.sequence = from.sequence();
  if (from.sequence() == 0) check->Fail(path / "sequence", "must be at least 1", v1::MISSING);
  ReadTarget(path, from, check, &out);
  const Parts parts(from);
  const bool blast = from.has_sphere() && from.sphere().outward() != 0;
  if (parts.given() > 1) {
    check->Fail(path / (parts.force ? "force" : "velocity_change"),
                "is given beside another kind of push; send them as two", v1::CONFLICT);
  } else if (parts.given() == 0 && !blast) {
    check->Fail(path / "impulse", "must be given, or another kind of push, or sphere.outward", v1::MISSING);
  }
  ReadPoint(path, from, parts, check, &out);
  if (parts.force) {
    ReadForce(path, from, tick_us, check, &out);
    return out;
  }
  if (from.has_duration())
    check->Fail(path / "duration", "has a meaning only with a force; leave it out", v1::CONFLICT);
  if (parts.change) {
    out.kind = Input::Kind::kVelocityChange;
    out.linear = check->Vector(limits::kSpeed, path / "velocity_change", from.velocity_change());
    out.angular = check->Vector(limits::kSpin, path / "spin_change", from.spin_change());
  } else {
    out.linear = check->Vector(limits::kImpulse, path / "impulse", from.impulse());
    out.angular = check->Vector(limits::kImpulse, path / "torque_impulse", from.torque_impulse());
  }
  return out;
}

bool IsWithin(const ClientLimits& limits, const Input& input) {
  const double most = input.kind == Input::Kind::kImpulse ? limits.impulse : limits.velocity_change;
  const auto ticks = static_cast<double>(input.ticks);
  return (input.linear.norm() + std::abs(input.area.outward)) * ticks <= most && input.angular.norm() * ticks <= most;
}

}  // namespace aureole
