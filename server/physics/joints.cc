#include "server/physics/joints.h"

namespace aureole::physics {
namespace {

// Frame at `pivot` whose z is the hinge's axis and whose x is `x`.
btTransform HingeFrame(const Vec3& pivot, const btVector3& axis, const btVector3& x) {
  const btVector3 y = axis.cross(x);
  const btMatrix3x3 basis(x.x(), y.x(), axis.x(), x.y(), y.y(), axis.y(), x.z(), y.z(), axis.z());
  return btTransform(basis, ToBullet(pivot));
}

std::unique_ptr<btTypedConstraint> MakeHinge(const JointSpec& spec, btRigidBody& a, btRigidBody& b) {
  // Bullet's own constructor from axes takes the zero angle from the present pose, which is history.
  const btVector3 axis_a = ToBullet(spec.axis_a).normalized(), axis_b = ToBullet(spec.axis_b).normalized();
  btVector3 x, y;
  btPlaneSpace1(axis_a, x, y);
  const btVector3 turned = quatRotate(shortestArcQuat(axis_a, axis_b), x);
  auto hinge = std::make_unique<btHingeConstraint>(a, b, HingeFrame(spec.pivot_a, axis_a, x),
                                                   HingeFrame(spec.pivot_b, axis_b, turned));
  if (spec.limited) hinge->setLimit(spec.lower, spec.upper, 0.9, 0.3, 0);  // the last: stops do not bounce
  return hinge;
}

}  // namespace

std::unique_ptr<btTypedConstraint> MakeConstraint(const JointSpec& spec, btRigidBody& a, btRigidBody& b) {
  switch (spec.kind) {
    case JointKind::kPoint:
      return std::make_unique<btPoint2PointConstraint>(a, b, ToBullet(spec.pivot_a), ToBullet(spec.pivot_b));
    case JointKind::kHinge:
      return MakeHinge(spec, a, b);
    case JointKind::kFixed:
      return std::make_unique<btFixedConstraint>(a, b, ToBullet(spec.frame_a, spec.pivot_a),
                                                 ToBullet(spec.frame_b, spec.pivot_b));
  }
  return nullptr;
}

}  // namespace aureole::physics
