#include "server/transport/shape_proto.h"

#include <cmath>

namespace aureole {

void SetVec3(const Vec3& v, v1::Vec3* out) {
  out->set_x(v.x());
  out->set_y(v.y());
  out->set_z(v.z());
}

void SetQuat(const Quat& q, v1::Quaternion* out) {
  out->set_x(q.x());
  out->set_y(q.y());
  out->set_z(q.z());
  out->set_w(q.w());
}

v1::Shape ShapeToProto(const Shape& shape) {
  v1::Shape out;
  switch (shape.kind) {
    case ShapeKind::kSphere:
      out.mutable_sphere()->set_radius(shape.radius);
      break;
    case ShapeKind::kBox:
      SetVec3(2 * shape.half, out.mutable_box()->mutable_size());
      break;
    case ShapeKind::kCapsule:
      out.mutable_capsule()->set_radius(shape.radius);
      out.mutable_capsule()->set_height(2 * shape.half.y());
      break;
    case ShapeKind::kCylinder:
      out.mutable_cylinder()->set_radius(shape.radius);
      out.mutable_cylinder()->set_height(2 * shape.half.y());
      break;
    case ShapeKind::kHull:
      for (const Vec3& p : shape.points) SetVec3(p, out.mutable_hull()->add_points());
      break;
    case ShapeKind::kCompound:
      for (const ChildShape& child : shape.children) {
        auto* c = out.mutable_compound()->add_children();
        SetVec3(child.position, c->mutable_position());
        SetQuat(child.orientation, c->mutable_orientation());
        *c->mutable_shape() = ShapeToProto(*child.shape);
      }
      break;
    case ShapeKind::kPlane:
      SetVec3(shape.normal, out.mutable_plane()->mutable_normal());
      out.mutable_plane()->set_offset(shape.offset);
      break;
    case ShapeKind::kMesh:
      for (const Vec3& p : shape.points) SetVec3(p, out.mutable_mesh()->add_points());
      out.mutable_mesh()->mutable_triangles()->Add(shape.triangles.begin(), shape.triangles.end());
      break;
    case ShapeKind::kHeightfield:
      out.mutable_heightfield()->set_rows(static_cast<uint32_t>(shape.rows));
      out.mutable_heightfield()->set_columns(static_cast<uint32_t>(shape.columns));
      out.mutable_heightfield()->set_cell(shape.cell);
      out.mutable_heightfield()->mutable_heights()->Add(shape.heights.begin(), shape.heights.end());
      break;
  }
  return out;
}

namespace {

google::protobuf::Duration ToDuration(double seconds) {
  const auto us = static_cast<int64_t>(std::llround(seconds * 1e6));
  google::protobuf::Duration out;
  out.set_seconds(us / 1'000'000);
  out.set_nanos(static_cast<int32_t>(us % 1'000'000 * 1000));
  return out;
}

void AddKey(double time, const Vec3& position, const Quat& orientation, v1::FixedBody* out) {
  v1::Mover::Key* key = out->add_keys();
  *key->mutable_time() = ToDuration(time);
  SetVec3(position, key->mutable_position());
  SetQuat(orientation, key->mutable_orientation());
}

}  // namespace

v1::FixedBody FixedToProto(const BodySpec& body) {
  v1::FixedBody out;
  out.set_body(body.id);
  *out.mutable_shape() = ShapeToProto(*body.shape);
  *out.mutable_material() = MaterialToProto(body.material);
  if (body.script == nullptr) {
    AddKey(0, body.position, body.orientation, &out);
    return out;
  }
  for (const Script::Key& key : body.script->keys) AddKey(key.time, key.position, key.orientation, &out);
  if (body.script->period > 0) *out.mutable_period() = ToDuration(body.script->period);
  return out;
}

v1::Material MaterialToProto(const Material& material) {
  v1::Material out;
  out.set_friction(material.friction);
  out.set_rolling_friction(material.rolling_friction);
  out.set_spinning_friction(material.spinning_friction);
  out.set_restitution(material.restitution);
  out.set_linear_damping(material.linear_damping);
  out.set_angular_damping(material.angular_damping);
  return out;
}

}  // namespace aureole
