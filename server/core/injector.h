// Injectors: scripted sources of bodies. A pure function of (world seed, injector, tick), so that every region knows
// every spawn without a message (the paper's section 5 is two of these).
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "server/core/scene.h"

namespace aureole {

struct InjectorShape {
  std::shared_ptr<const Shape> shape;
  double mass = 1;
  double weight = 1;  // share in the mix
  Material material;
  bool ccd = false;
};

struct Injector {
  double rate = 0;      // bodies per second of simulated time
  double start = 0;     // s
  double duration = 0;  // s
  struct Volume {
    Vec3 min = Vec3::Zero(), max = Vec3::Zero();  // centres are uniform in this box
    double weight = 1;
  };
  std::vector<Volume> volumes;
  std::vector<InjectorShape> shapes;
  Vec3 min_velocity = Vec3::Zero(), max_velocity = Vec3::Zero();  // uniform per axis, m/s
  double max_spin = 0;                                            // rad/s, per axis
  bool random_orientation = true;
};

// The ids of injected bodies: bit 62 set, then the injector (14 bits), then the body's number (48 bits).
BodyId InjectedId(int injector, uint64_t number);

// How many bodies the injector has made by the end of tick `n` (inclusive).
uint64_t InjectedBy(const Injector& injector, int64_t tick_us, Tick n);

// Appends the spawns of tick `n` (source 0), in their order. Cost: the spawns made.
void InjectorInputs(const std::vector<Injector>& injectors, uint64_t seed, int64_t tick_us, Tick n,
                    std::vector<Input>* out);

}  // namespace aureole
