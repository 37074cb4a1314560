// The world of the benchmarks about clients: everything moves for ever, and costs little.
#pragma once

#include <cstdint>

#include "aureole/v1/world.pb.h"

namespace aureole {

inline constexpr int64_t kRollingTickUs = 16'667;  // 60 per second

// Spheres that roll for ever, in lanes.
inline v1::WorldSpec Rolling(int bodies) {
  v1::WorldSpec spec;
  spec.set_name("rolling");
  spec.mutable_tick()->set_nanos(static_cast<int32_t>(kRollingTickUs * 1000));
  v1::Material& smooth = (*spec.mutable_materials())["default"];
  smooth.set_friction(0.5);
  smooth.set_angular_damping(0);
  spec.mutable_sleeping()->set_linear(0);
  spec.mutable_sleeping()->set_angular(0);
  spec.add_statics()->mutable_shape()->mutable_plane()->mutable_normal()->set_y(1);
  for (int i = 0; i < bodies; ++i) {
    v1::Body* b = spec.add_bodies();
    b->mutable_shape()->mutable_sphere()->set_radius(0.5);
    b->set_mass(1);
    b->mutable_position()->set_x(i % 25 * 4 - 50);
    b->mutable_position()->set_y(0.5);
    b->mutable_position()->set_z(i / 25 * 2 - 40);
    b->mutable_velocity()->set_x(i / 25 % 2 == 0 ? 1.5 : -1.5);
  }
  return spec;
}

}  // namespace aureole
