#include "client/src/convert.h"

#include <algorithm>
#include <cmath>

#include "aureole/v1/error.pb.h"

namespace aureole::client {
namespace {

Vec3 From(const v1::Vec3& v) { return {v.x(), v.y(), v.z()}; }

void Set(const Vec3& v, v1::Vec3* out) {
  out->set_x(v.x);
  out->set_y(v.y);
  out->set_z(v.z);
}

void Set(const Quaternion& q, v1::Quaternion* out) {
  out->set_x(q.x);
  out->set_y(q.y);
  out->set_z(q.z);
  out->set_w(q.w);
}

bool IsZero(const Vec3& v) { return v.x == 0 && v.y == 0 && v.z == 0; }

Shape ShapeFrom(const v1::Shape& in) {
  Shape out;
  switch (in.kind_case()) {
    case v1::Shape::kSphere:
      out.radius = in.sphere().radius();
      break;
    case v1::Shape::kBox:
      out.kind = Shape::Kind::kBox;
      out.size = From(in.box().size());
      break;
    case v1::Shape::kCapsule:
      out.kind = Shape::Kind::kCapsule;
      out.radius = in.capsule().radius();
      out.height = in.capsule().height();
      break;
    case v1::Shape::kCylinder:
      out.kind = Shape::Kind::kCylinder;
      out.radius = in.cylinder().radius();
      out.height = in.cylinder().height();
      break;
    case v1::Shape::kHull:
      out.kind = Shape::Kind::kHull;
      for (const v1::Vec3& p : in.hull().points()) out.points.push_back(From(p));
      break;
    case v1::Shape::kCompound:
      out.kind = Shape::Kind::kCompound;
      for (const auto& c : in.compound().children()) {
        out.children.push_back({From(c.position()),
                                {c.orientation().x(), c.orientation().y(), c.orientation().z(), c.orientation().w()},
                                ShapeFrom(c.shape())});
      }
      break;
    default:
      break;  // never of a dynamic body
  }
  return out;
}

}  // namespace

Status FromGrpc(const grpc::Status& status) {
  Status out{static_cast<int>(status.error_code()), status.error_message(), "", ""};
  v1::ErrorStatus details;
  v1::ErrorDetail detail;
  if (!status.ok() && details.ParseFromString(status.error_details()) && details.details_size() > 0 &&
      details.details(0).UnpackTo(&detail)) {
    out.reason = v1::Reason_Name(detail.reason());
    out.field = detail.field();
  }
  return out;
}

Look LookFrom(const v1::BodyDescription& d) { return {ShapeFrom(d.shape()), d.mass()}; }

World WorldFrom(const v1::GetWorldResponse& in) {
  World out;
  out.name = in.name();
  out.tick_seconds = static_cast<double>(in.tick_us()) * 1e-6;
  out.layout_epoch = in.layout_epoch();
  for (int i = 0; i < std::min(in.endpoints_size(), in.layout_size()); ++i) {
    const v1::RegionRect& r = in.layout(i);
    out.regions.push_back({in.endpoints(i), {r.min_x(), r.max_x(), r.min_z(), r.max_z()}});
  }
  return out;
}

v1::StreamReplicasRequest RequestOf(const WatchOptions& o) {
  v1::StreamReplicasRequest out;
  out.set_rate(o.rate);
  out.set_precision(static_cast<v1::Precision>(o.precision));
  out.set_velocities(o.velocities);
  if (o.precision != Precision::kExact) out.set_encoding(v1::BITS);
  Vec3 middle;
  if (o.sphere.has_value()) {
    middle = o.sphere->centre;
    Set(middle, out.mutable_view()->mutable_sphere()->mutable_centre());
    out.mutable_view()->mutable_sphere()->set_radius(o.sphere->radius);
  } else if (o.rect.has_value()) {
    middle = {(o.rect->min_x + o.rect->max_x) / 2, 0, (o.rect->min_z + o.rect->max_z) / 2};
    Set({o.rect->min_x, 0, o.rect->min_z}, out.mutable_view()->mutable_box()->mutable_min());
    Set({o.rect->max_x, 0, o.rect->max_z}, out.mutable_view()->mutable_box()->mutable_max());
  }
  if (o.full_within != 0) {
    Set(middle, out.mutable_level_of_detail()->mutable_eye());
    out.mutable_level_of_detail()->set_full_within(o.full_within);
  }
  return out;
}

v1::Impulse ImpulseOf(const Push& push, uint64_t sequence) {
  v1::Impulse out;
  out.set_sequence(sequence);
  out.set_body(push.body);
  if (push.sphere.has_value()) {
    Set(push.sphere->centre, out.mutable_sphere()->mutable_centre());
    out.mutable_sphere()->set_radius(push.sphere->radius);
    out.mutable_sphere()->set_outward(push.outward);
    out.mutable_sphere()->set_fades(push.fades);
  }
  const bool linear = !IsZero(push.linear) || IsZero(push.angular);
  switch (push.kind) {
    case Push::Kind::kImpulse:
      if (linear) Set(push.linear, out.mutable_impulse());
      if (!IsZero(push.angular)) Set(push.angular, out.mutable_torque_impulse());
      break;
    case Push::Kind::kVelocityChange:
      if (linear) Set(push.linear, out.mutable_velocity_change());
      if (!IsZero(push.angular)) Set(push.angular, out.mutable_spin_change());
      break;
    case Push::Kind::kForce: {
      if (linear) Set(push.linear, out.mutable_force());
      if (!IsZero(push.angular)) Set(push.angular, out.mutable_torque());
      // The servers count in microseconds. What is no time at all is theirs to refuse.
      const int64_t us = std::isfinite(push.seconds) ? std::llround(std::clamp(push.seconds, -1e9, 1e9) * 1e6) : 0;
      out.mutable_duration()->set_seconds(us / 1'000'000);
      out.mutable_duration()->set_nanos(static_cast<int32_t>(us % 1'000'000 * 1000));
      break;
    }
  }
  if (push.point.has_value()) Set(*push.point, out.mutable_at_point());
  if (push.body_point.has_value()) Set(*push.body_point, out.mutable_at_body_point());
  return out;
}

v1::Body BodyOf(const NewBody& body) {
  v1::Body out;
  v1::Shape* shape = out.mutable_shape();
  switch (body.shape.kind) {
    case Shape::Kind::kSphere:
      shape->mutable_sphere()->set_radius(body.shape.radius);
      break;
    case Shape::Kind::kBox:
      Set(body.shape.size, shape->mutable_box()->mutable_size());
      break;
    case Shape::Kind::kCapsule:
      shape->mutable_capsule()->set_radius(body.shape.radius);
      shape->mutable_capsule()->set_height(body.shape.height);
      break;
    case Shape::Kind::kCylinder:
      shape->mutable_cylinder()->set_radius(body.shape.radius);
      shape->mutable_cylinder()->set_height(body.shape.height);
      break;
    case Shape::Kind::kHull:
      for (const Vec3& p : body.shape.points) Set(p, shape->mutable_hull()->add_points());
      break;
    default:
      break;  // the server says that a shape is missing
  }
  out.set_mass(body.mass);
  Set(body.position, out.mutable_position());
  Set(body.orientation, out.mutable_orientation());
  Set(body.velocity, out.mutable_velocity());
  Set(body.angular_velocity, out.mutable_angular_velocity());
  return out;
}

}  // namespace aureole::client
