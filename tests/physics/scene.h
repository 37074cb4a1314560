// Random scenes with everything an engine can simulate, for tests of exactness.
#pragma once

#include <cstdint>
#include <vector>

#include "server/core/scene.h"

namespace aureole {

// Counter-based random numbers: a value is a function of the key, whatever was drawn before.
uint64_t Mix(uint64_t x);
double Uniform(uint64_t key, double from, double to);

struct PhysicsScene {
  Environment environment;
  std::vector<BodySpec> bodies;
  std::vector<JointSpec> joints;
  std::vector<Input> inputs;  // sorted; impulses, velocities, spawns, removals
};

// `clusters` heaps of `per` bodies on pedestals of all static kinds, kinematic pushers, turntables and gates that
// start and stop, joints of all kinds, materials of all kinds, a third of the bodies with CCD. Inputs every 50 ticks.
PhysicsScene MakePhysicsScene(uint64_t seed, int clusters, int per, Tick ticks);

// Bodies far from any such scene, at random places within 40 m.
std::vector<BodySpec> MakeUnrelated(uint64_t seed, int count);

std::shared_ptr<const Shape> SphereShape(double radius);
std::shared_ptr<const Shape> BoxShape(double x, double y, double z);  // half extents
std::shared_ptr<const Shape> CapsuleShape(double radius, double half_height);
BodySpec StaticBody(BodyId id, std::shared_ptr<const Shape> shape, const Vec3& position);
BodySpec GroundPlane(BodyId id);

}  // namespace aureole
