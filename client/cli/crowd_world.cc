#include "client/cli/crowd_world.h"

#include <cmath>
#include <vector>

#include <absl/strings/str_format.h>

namespace aureole {
namespace {

constexpr double kMinRadius = 0.2, kMaxRadius = 0.4;  // m, of the bounding sphere
constexpr double kApart = 0.02;                       // m, between bodies at the start
constexpr double kSlow = 5, kFast = 32;               // m/s
constexpr double kFastShare = 0.02, kFastLeast = 0.3 * kFast;
constexpr double kKickShare = 0.01;  // of the bodies, in each tick
// A body at 32 m/s moves half a metre in a tick: a thinner wall would let it through.
constexpr double kWallThickness = 2, kWallHeight = 2;

// SplitMix64 (Steele, Lea and Flood, 2014): the same numbers on every machine and library.
class Draws {
 public:
  explicit Draws(uint64_t seed) : state_(seed) {}
  double Unit() {
    uint64_t z = state_ += 0x9e3779b97f4a7c15u;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return static_cast<double>((z ^ (z >> 31)) >> 11) * 0x1p-53;
  }
  double Between(double min, double max) { return min + Unit() * (max - min); }

 private:
  uint64_t state_;
};

struct Disc {
  double x, z, radius;
};

v1::Vec3 Vector(double x, double y, double z) {
  v1::Vec3 v;
  v.set_x(x);
  v.set_y(y);
  v.set_z(z);
  return v;
}

// Random places, one body after the other, each where it overlaps none before it.
std::vector<Disc> Place(int count, Draws* draws) {
  std::vector<Disc> discs;
  while (static_cast<int>(discs.size()) < count) {
    const double radius = draws->Between(kMinRadius, kMaxRadius);
    const double x = draws->Between(-kCrowdWidth / 2 + radius, kCrowdWidth / 2 - radius);
    const double z = draws->Between(-kCrowdDepth / 2 + radius, kCrowdDepth / 2 - radius);
    bool free = true;
    for (const Disc& d : discs) {
      const double apart = d.radius + radius + kApart, dx = d.x - x, dz = d.z - z;
      if (dx * dx + dz * dz < apart * apart) free = false;
    }
    if (free) discs.push_back({x, z, radius});
  }
  return discs;
}

// Any direction along the ground. By rejection: sine and cosine differ between libraries.
v1::Vec3 Velocity(bool may_be_fast, Draws* draws) {
  const bool fast = may_be_fast && draws->Unit() < kFastShare;
  const double speed = fast ? draws->Between(kFastLeast, kFast) : draws->Between(0, kSlow);
  double x = 0, z = 0, squared = 0;
  do {
    x = draws->Between(-1, 1);
    z = draws->Between(-1, 1);
    squared = x * x + z * z;
  } while (squared > 1 || squared < 1e-4);
  const double scale = speed / std::sqrt(squared);
  return Vector(x * scale, 0, z * scale);
}

void AddWall(double x, double z, double size_x, double size_z, v1::WorldSpec* spec) {
  v1::StaticBody* wall = spec->add_statics();
  *wall->mutable_position() = Vector(x, kWallHeight / 2, z);
  *wall->mutable_shape()->mutable_box()->mutable_size() = Vector(size_x, kWallHeight, size_z);
}

void AddArena(v1::WorldSpec* spec) {
  *spec->add_statics()->mutable_shape()->mutable_plane()->mutable_normal() = Vector(0, 1, 0);
  const double x = (kCrowdWidth + kWallThickness) / 2, z = (kCrowdDepth + kWallThickness) / 2;
  for (const double side : {-1.0, 1.0}) {
    AddWall(side * x, 0, kWallThickness, kCrowdDepth, spec);
    AddWall(0, side * z, kCrowdWidth + 2 * kWallThickness, kWallThickness, spec);
  }
}

void AddBody(const Disc& place, Draws* draws, v1::WorldSpec* spec) {
  v1::Body* body = spec->add_bodies();
  body->set_id(static_cast<uint64_t>(spec->bodies_size()));
  double height = place.radius;
  if (draws->Unit() < 0.5) {
    body->mutable_shape()->mutable_sphere()->set_radius(place.radius);
  } else {
    height /= std::sqrt(3.0);
    *body->mutable_shape()->mutable_box()->mutable_size() = Vector(2 * height, 2 * height, 2 * height);
  }
  *body->mutable_position() = Vector(place.x, height, place.z);
  *body->mutable_velocity() = Velocity(false, draws);
}

void AddKick(uint64_t body, Tick tick, bool may_be_fast, Draws* draws, v1::WorldSpec* spec) {
  v1::Event* event = spec->add_events();
  const int64_t us = tick * kCrowdTickUs;
  event->mutable_at()->set_seconds(us / 1'000'000);
  event->mutable_at()->set_nanos(static_cast<int32_t>(us % 1'000'000) * 1000);
  event->mutable_velocity()->set_body(body);
  *event->mutable_velocity()->mutable_linear() = Velocity(may_be_fast, draws);
}

}  // namespace

std::string CrowdName(const Crowd& crowd) {
  return absl::StrFormat("crowd-%.0f-%s", crowd.density * 100, crowd.fast ? "fast" : "slow");
}

v1::WorldSpec CrowdWorld(const Crowd& crowd) {
  v1::WorldSpec spec;
  spec.set_name(CrowdName(crowd));
  spec.set_seed(crowd.seed);
  spec.mutable_tick()->set_nanos(static_cast<int32_t>(kCrowdTickUs) * 1000);
  spec.mutable_tolerances()->set_speed(kFast);
  spec.set_speed_limit(kFast);
  spec.mutable_layout()->mutable_columns()->add_edges(0);
  v1::Material& material = (*spec.mutable_materials())["default"];
  material.set_friction(0.2);  // 0.04 between two: half a metre per second is lost from one kick to the next
  material.set_restitution(0.7);
  AddArena(&spec);

  Draws draws(crowd.seed);
  const int count = static_cast<int>(std::lround(crowd.density * kCrowdWidth * kCrowdDepth));
  for (const Disc& place : Place(count, &draws)) AddBody(place, &draws, &spec);
  for (Tick tick = 1; tick <= crowd.ticks; ++tick) {
    for (int i = 0; i < count; ++i) {
      if (draws.Unit() < kKickShare) AddKick(static_cast<uint64_t>(i) + 1, tick, crowd.fast, &draws, &spec);
    }
  }
  return spec;
}

}  // namespace aureole
