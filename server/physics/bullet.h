// Bullet's headers in double precision, and conversion between its types and ours.
#pragma once

#include <BulletCollision/CollisionDispatch/btCollisionObjectWrapper.h>
#include <btBulletDynamicsCommon.h>

#include "server/core/types.h"

namespace aureole::physics {

static_assert(sizeof(btScalar) == 8, "Aureole needs the float64 build of Bullet");

// Bullet's contact points live up to this distance, and boxes are grown by it (Bullet's gContactBreakingThreshold).
inline constexpr double kBreakingMargin = 0.02;
// However hard a body is struck: in 100 days it gets no further than a state may hold (codec.h), and no square of a
// velocity overflows.
inline constexpr double kMostSpeed = 1e5;  // m/s
inline constexpr double kMostSpin = 1e5;   // rad/s

inline btVector3 ToBullet(const Vec3& v) { return {v.x(), v.y(), v.z()}; }
inline btQuaternion ToBullet(const Quat& q) { return {q.x(), q.y(), q.z(), q.w()}; }
inline btTransform ToBullet(const Quat& q, const Vec3& p) { return btTransform(ToBullet(q), ToBullet(p)); }
inline Vec3 FromBullet(const btVector3& v) { return {v.x(), v.y(), v.z()}; }

}  // namespace aureole::physics
