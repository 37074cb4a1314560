#include "server/physics/script_pose.h"

#include <cmath>

namespace aureole::physics {
namespace {

// Along the shorter arc; linear where the arc is too short for its sine.
Quat Slerp(const Quat& from, const Quat& to, double share) {
  double cosine = from.dot(to);
  const double sign = cosine < 0 ? -1 : 1;
  cosine *= sign;
  double a = 1 - share, b = share;
  if (cosine < 0.9999) {
    const double angle = std::acos(cosine), sine = std::sin(angle);
    a = std::sin(a * angle) / sine;
    b = std::sin(b * angle) / sine;
  }
  b *= sign;
  Quat q(a * from.w() + b * to.w(), a * from.x() + b * to.x(), a * from.y() + b * to.y(), a * from.z() + b * to.z());
  q.normalize();
  return q;
}

}  // namespace

btTransform PoseAt(const Script& script, double seconds, const btTransform& rest) {
  const auto& keys = script.keys;
  if (keys.empty()) return rest;
  const double t = script.period > 0 ? std::fmod(seconds, script.period) : seconds;
  size_t next = 0;
  while (next < keys.size() && keys[next].time <= t) ++next;
  if (next == 0) return ToBullet(keys.front().orientation, keys.front().position);
  if (next == keys.size()) return ToBullet(keys.back().orientation, keys.back().position);
  const Script::Key &a = keys[next - 1], &b = keys[next];
  const double share = (t - a.time) / (b.time - a.time);
  const Vec3 position = a.position + share * (b.position - a.position);
  return ToBullet(Slerp(a.orientation, b.orientation, share), position);
}

}  // namespace aureole::physics
