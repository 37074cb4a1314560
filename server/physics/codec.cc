#include "server/physics/codec.h"

#include <cmath>
#include <utility>

namespace aureole::physics {
namespace {

void PutQuat(const Quat& q, ByteWriter* out) {
  for (double x : {q.w(), q.x(), q.y(), q.z()}) out->Put(x);
}

// Unit length within rounding; else fails.
Quat GetQuat(ByteReader* in) {
  double x[4];
  for (double& value : x) value = in->GetFinite(1.001);
  const Quat q(x[0], x[1], x[2], x[3]);
  if (std::abs(q.squaredNorm() - 1) > 1e-6) in->Fail();
  return q;
}

Vec3 GetUnit(ByteReader* in) {
  const Vec3 v = GetVec3(1.001, in);
  if (std::abs(v.squaredNorm() - 1) > 1e-6) in->Fail();
  return v;
}

bool GetBool(ByteReader* in) {
  const uint8_t b = in->Get<uint8_t>();
  if (b > 1) in->Fail();
  return b == 1;
}

double GetExtent(ByteReader* in) {
  const double x = in->GetFinite(kMaxExtent);
  if (x < kMinExtent) in->Fail();
  return x;
}

void PutShape(const Shape& s, ByteWriter* out) {
  out->Put(static_cast<uint8_t>(s.kind));
  switch (s.kind) {
    case ShapeKind::kSphere:
      out->Put(s.radius);
      break;
    case ShapeKind::kBox:
      PutVec3(s.half, out);
      break;
    case ShapeKind::kCapsule:
    case ShapeKind::kCylinder:
      out->Put(s.radius);
      out->Put(s.half.y());
      break;
    case ShapeKind::kHull:
      out->Put(static_cast<uint32_t>(s.points.size()));
      for (const Vec3& p : s.points) PutVec3(p, out);
      break;
    case ShapeKind::kCompound:
      out->Put(static_cast<uint32_t>(s.children.size()));
      for (const ChildShape& c : s.children) {
        PutVec3(c.position, out);
        PutQuat(c.orientation, out);
        PutShape(*c.shape, out);
      }
      break;
    case ShapeKind::kPlane:
      PutVec3(s.normal, out);
      out->Put(s.offset);
      break;
    case ShapeKind::kMesh:
      out->Put(static_cast<uint32_t>(s.points.size()));
      for (const Vec3& p : s.points) PutVec3(p, out);
      out->Put(static_cast<uint32_t>(s.triangles.size()));
      for (uint32_t t : s.triangles) out->Put(t);
      break;
    case ShapeKind::kHeightfield:
      out->Put(s.rows);
      out->Put(s.columns);
      out->Put(s.cell);
      for (double h : s.heights) out->Put(h);
      break;
  }
}

// Whether the points span a volume.
bool SpansVolume(const std::vector<Vec3>& p) {
  if (p.size() < 4) return false;
  double best = 0;
  Vec3 along = Vec3::Zero();
  for (const Vec3& q : p) {
    const Vec3 d = q - p[0];
    if (d.norm() > best) {
      best = d.norm();
      along = d / best;
    }
  }
  if (best < kMinExtent) return false;
  double wide = 0;
  Vec3 normal = Vec3::Zero();
  for (const Vec3& q : p) {
    const Vec3 c = along.cross(q - p[0]);
    if (c.norm() > wide) {
      wide = c.norm();
      normal = c / wide;
    }
  }
  if (wide < kMinExtent) return false;
  double high = 0;
  for (const Vec3& q : p) high = std::max(high, std::abs(normal.dot(q - p[0])));
  return high >= kMinExtent;
}

std::shared_ptr<const Shape> GetShape(bool child, ByteReader* in) {
  auto s = std::make_shared<Shape>();
  s->kind = static_cast<ShapeKind>(in->Get<uint8_t>());
  switch (s->kind) {
    case ShapeKind::kSphere:
      s->radius = GetExtent(in);
      break;
    case ShapeKind::kBox:
      for (int i = 0; i < 3; ++i) s->half[i] = GetExtent(in);
      break;
    case ShapeKind::kCapsule:
      s->radius = GetExtent(in);
      s->half.y() = GetExtent(in);
      if (s->half.y() <= s->radius) in->Fail();
      break;
    case ShapeKind::kCylinder:
      s->radius = GetExtent(in);
      s->half.y() = GetExtent(in);
      break;
    case ShapeKind::kHull: {
      const uint32_t n = in->GetCount(3 * sizeof(double));
      if (n > kMaxPoints) in->Fail();
      for (uint32_t i = 0; i < n && in->ok(); ++i) s->points.push_back(GetVec3(kMaxExtent, in));
      if (!SpansVolume(s->points)) in->Fail();
      break;
    }
    case ShapeKind::kCompound: {
      if (child) in->Fail();
      const uint32_t n = in->GetCount(7 * sizeof(double));
      if (n == 0 || n > kMaxChildren) in->Fail();
      for (uint32_t i = 0; i < n && in->ok(); ++i) {
        ChildShape c;
        c.position = GetVec3(kMaxExtent, in);
        c.orientation = GetQuat(in);
        c.shape = GetShape(true, in);
        s->children.push_back(std::move(c));
      }
      break;
    }
    default:
      in->Fail();
  }
  return s;
}

}  // namespace

void PutVec3(const Vec3& v, ByteWriter* out) {
  for (int i = 0; i < 3; ++i) out->Put(v[i]);
}

Vec3 GetVec3(double bound, ByteReader* in) {
  Vec3 v;
  for (int i = 0; i < 3; ++i) v[i] = in->GetFinite(bound);
  return v;
}

std::string EncodeShape(const Shape& shape) {
  std::string bytes;
  {
    ByteWriter out(&bytes);
    PutShape(shape, &out);
  }
  return bytes;
}

std::shared_ptr<const Shape> DecodeDynamicShape(std::string_view bytes) {
  ByteReader in(bytes);
  std::shared_ptr<const Shape> s = GetShape(false, &in);
  return in.done() ? s : nullptr;
}

void PutMaterial(const Material& m, ByteWriter* out) {
  for (double x :
       {m.friction, m.rolling_friction, m.spinning_friction, m.restitution, m.linear_damping, m.angular_damping}) {
    out->Put(x);
  }
}

Material GetMaterial(ByteReader* in) {
  Material m;
  for (double* x : {&m.friction, &m.rolling_friction, &m.spinning_friction, &m.restitution}) {
    *x = in->GetFinite(kMaxQuantity);
    if (*x < 0) in->Fail();
  }
  for (double* x : {&m.linear_damping, &m.angular_damping}) {
    *x = in->GetFinite(1);
    if (*x < 0) in->Fail();
  }
  return m;
}

void PutJoint(const JointSpec& j, ByteWriter* out) {
  out->Put(j.id);
  out->Put(static_cast<uint8_t>(j.kind));
  out->Put(j.a);
  out->Put(j.b);
  for (const Vec3& v : {j.pivot_a, j.pivot_b, j.axis_a, j.axis_b}) PutVec3(v, out);
  PutQuat(j.frame_a, out);
  PutQuat(j.frame_b, out);
  out->Put(static_cast<uint8_t>(j.limited));
  out->Put(j.lower);
  out->Put(j.upper);
  out->Put(static_cast<uint8_t>(j.collide));
}

JointSpec GetJoint(ByteReader* in) {
  JointSpec j;
  j.id = in->Get<uint64_t>();
  j.kind = static_cast<JointKind>(in->Get<uint8_t>());
  if (j.kind != JointKind::kPoint && j.kind != JointKind::kHinge && j.kind != JointKind::kFixed) in->Fail();
  j.a = in->Get<uint64_t>();
  j.b = in->Get<uint64_t>();
  j.pivot_a = GetVec3(kMaxPosition, in);
  j.pivot_b = GetVec3(kMaxPosition, in);
  j.axis_a = GetUnit(in);
  j.axis_b = GetUnit(in);
  j.frame_a = GetQuat(in);
  j.frame_b = GetQuat(in);
  j.limited = GetBool(in);
  j.lower = in->GetFinite(7);
  j.upper = in->GetFinite(7);
  j.collide = GetBool(in);
  if (j.id == 0 || j.a == 0 || j.a == j.b || (j.limited && j.lower > j.upper)) in->Fail();
  return j;
}

}  // namespace aureole::physics
