// The records of the Bullet engine: bodies, pairs of bodies whose boxes are close, joints.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "server/core/scene.h"
#include "server/physics/bullet.h"
#include "server/physics/shapes.h"

struct btDbvtNode;

namespace aureole::physics {

struct Body;

// A contact algorithm of one part of each body; only compounds have more than one.
struct PartContact {
  uint32_t part_a = 0, part_b = 0;
  btCollisionAlgorithm* algorithm = nullptr;
};

// Two bodies whose leaves in the broadphase overlap; at least one is dynamic. Which pairs exist is history; only those
// whose exact boxes overlap may change anything (EXACT.md L2).
struct Pair {
  Body* a = nullptr;  // a->id < b->id: the order decides signs and reference bodies (L1)
  Body* b = nullptr;
  size_t index_a = 0, index_b = 0;    // in a->pairs and b->pairs
  std::vector<PartContact> contacts;  // ascending parts
  bool touches = false;               // one of them has points

  Body* Other(const Body* self) const { return self == a ? b : a; }
};

struct Joint {
  JointSpec spec;
  Body* a = nullptr;
  Body* b = nullptr;  // null: the world
  std::unique_ptr<btTypedConstraint> constraint;

  Body* Other(const Body* self) const { return self == a ? b : a; }
};

struct Body {
  Body(BodyId body_id, Motion body_motion, const btRigidBody::btRigidBodyConstructionInfo& info)
      : id(body_id), motion(body_motion), rigid(info) {}

  const BodyId id;
  const Motion motion;
  btRigidBody rigid;  // its user pointer is this record
  std::shared_ptr<const CollisionShape> shape;
  double mass = 0;
  Material material;
  double linear_keep = 1, angular_keep = 1;  // share of velocity that damping leaves per tick
  bool ccd = false;
  std::shared_ptr<const Script> script;

  btVector3 low, high;  // the exact box
  double swept = 0;     // m the exact box reaches beyond the shape because of CCD
  btDbvtNode* leaf = nullptr;
  std::vector<Pair*> pairs;
  std::vector<Joint*> joints;

  bool asleep = false;
  bool moving = false;   // kinematic: its pose changed in this tick
  uint32_t still = 0;    // ticks below the sleeping speeds in a row; 0 when asleep
  int island = -1;       // of the current step
  uint64_t visited = 0;  // the step that last put it into an island
  int outside = -1;      // place in the list of sleepers outside, or -1

  bool dynamic() const { return motion == Motion::kDynamic; }
};

// Whether the exact boxes overlap or touch; agrees with Overlap of core/types.h.
inline bool BoxesOverlap(const Body& a, const Body& b) {
  return a.low.x() <= b.high.x() && b.low.x() <= a.high.x() && a.low.y() <= b.high.y() && b.low.y() <= a.high.y() &&
         a.low.z() <= b.high.z() && b.low.z() <= a.high.z();
}

}  // namespace aureole::physics
