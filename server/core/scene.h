// What a world consists of, as the engine and the protocol see it: shapes, bodies, joints, scripts, inputs. Plain
// values, already validated (the WorldSpec loader refuses what is not sane); SI units, radians, y up.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "server/core/types.h"

namespace aureole {

enum class ShapeKind : uint8_t {
  kSphere = 1,       // radius
  kBox = 2,          // half
  kCapsule = 3,      // radius, half.y() = half of the total height along local y, caps included; > radius
  kCylinder = 4,     // radius, half.y() = half of the height along local y
  kHull = 5,         // points: at least 4, not coplanar
  kCompound = 6,     // children: spheres, boxes, capsules, cylinders, hulls
  kPlane = 7,        // static only: points x with normal . x <= offset are solid; |normal| = 1
  kMesh = 8,         // static only: points, triangles (indices, 3 per triangle)
  kHeightfield = 9,  // static only: rows x columns heights (row-major, rows along +z), cell size; centred on the origin
                     // in x and z, heights are local y
};

struct Shape;
struct ChildShape {
  Vec3 position = Vec3::Zero();  // in the compound's frame
  Quat orientation = Quat::Identity();
  std::shared_ptr<const Shape> shape;
};

// Immutable, shared between bodies. The centre of mass of a dynamic body is the origin of its shape.
struct Shape {
  ShapeKind kind = ShapeKind::kSphere;
  double radius = 0;
  Vec3 half = Vec3::Zero();
  Vec3 normal = Vec3::UnitY();
  double offset = 0;
  std::vector<Vec3> points;
  std::vector<uint32_t> triangles;
  std::vector<ChildShape> children;
  int rows = 0, columns = 0;
  double cell = 1;
  std::vector<double> heights;
};

struct Material {
  double friction = 0.7;  // Coulomb; the coefficients of two bodies are multiplied
  double rolling_friction = 0;
  double spinning_friction = 0;
  double restitution = 0;     // multiplied; 0..1
  double linear_damping = 0;  // share of velocity lost per second, 0..1
  double angular_damping = 0.05;
};

// Motion of a kinematic body as a function of simulated time only, so that every region can evaluate it (P40).
struct Script {
  struct Key {
    double time = 0;  // s, strictly increasing
    Vec3 position = Vec3::Zero();
    Quat orientation = Quat::Identity();
  };
  std::vector<Key> keys;  // linear in position, slerp in orientation between keys; constant outside
  double period = 0;      // s; > 0: time is taken modulo period
};

enum class Motion : uint8_t { kDynamic = 0, kStatic = 1, kKinematic = 2 };

struct BodySpec {
  BodyId id = 0;
  Motion motion = Motion::kDynamic;
  std::shared_ptr<const Shape> shape;
  double mass = 1;  // kg; dynamic only, > 0
  Vec3 position = Vec3::Zero();
  Quat orientation = Quat::Identity();
  Vec3 velocity = Vec3::Zero();          // m/s
  Vec3 angular_velocity = Vec3::Zero();  // rad/s, world frame
  Material material;
  bool ccd = false;                      // swept against tunnelling when it moves further than its own size in a tick
  bool asleep = false;                   // starts asleep (velocities must be 0)
  std::shared_ptr<const Script> script;  // kinematic only
};

enum class JointKind : uint8_t { kPoint = 1, kHinge = 2, kFixed = 3 };

// Joins two dynamic bodies, or one (b = 0) to the world frame. Jointed bodies have one owner, always.
struct JointSpec {
  JointId id = 0;
  JointKind kind = JointKind::kPoint;
  BodyId a = 0, b = 0;
  Vec3 pivot_a = Vec3::Zero(), pivot_b = Vec3::Zero();          // body frames (world frame for b = 0)
  Vec3 axis_a = Vec3::UnitZ(), axis_b = Vec3::UnitZ();          // hinge
  Quat frame_a = Quat::Identity(), frame_b = Quat::Identity();  // fixed: frames that are kept aligned
  bool limited = false;                                         // hinge
  double lower = 0, upper = 0;
  bool collide = false;  // do the two bodies collide with each other
};

// The dynamic bodies whose centre of mass lies in a closed sphere.
struct Area {
  Vec3 centre = Vec3::Zero();
  double radius = 0;  // m; 0: no area
  // Added to the linear part of each body's input: so much away from the centre, or towards it. Nothing for a body at
  // the centre.
  double outward = 0;
  bool fades = false;  // `outward` falls off linearly, to 0 at the radius
};

// How the world is to be divided from some tick on (server/core/division.h).
struct LayoutChange {
  uint64_t epoch = 0;             // of the layout; one more than that of the layout before
  std::vector<Rect> regions;      // by RegionId; Rect{}: without area. No fewer than before
  std::vector<int> ranks;         // one per region, a permutation of 0..n-1
  std::vector<RegionId> members;  // those that have a server, ascending; all that have an area are
  friend bool operator==(const LayoutChange&, const LayoutChange&) = default;
};

// Of inputs: what the control plane says. No client's.
inline constexpr uint64_t kControlSource = ~uint64_t{0};

// What changes a running world. Takes effect at the start of a tick, before its exchange and step (PROTOCOL.md R13);
// inputs of one tick apply in (source, sequence) order.
struct Input {
  enum class Kind : uint8_t {
    kSpawn = 1,           // `spawn`
    kRemove = 2,          // `body`; what touched it wakes (P59)
    kImpulse = 3,         // `linear` N s at `point` and `angular` N m s; wakes
    kVelocity = 4,        // sets both velocities; wakes
    kVelocityChange = 5,  // adds to both velocities; wakes
    kLayout = 6,          // `layout`, of the control plane; changes no body
  };
  // Of the point where a linear impulse acts.
  enum class Frame : uint8_t {
    kCentre = 0,  // no point: the centre of mass
    kWorld = 1,
    kBody = 2,  // turns with the body; the centre of mass is its origin
  };
  Tick tick = 0;
  uint64_t source = 0;    // 0: the world's script; kControlSource; else a client
  uint64_t sequence = 0;  // grows with every input of a source
  Kind kind = Kind::kImpulse;
  BodyId body = 0;  // of a spawn: that of `spawn`
  Area area;        // of a client's impulse or change of velocity: instead of `body`
  Vec3 linear = Vec3::Zero();
  Vec3 angular = Vec3::Zero();
  Frame frame = Frame::kCentre;
  Vec3 point = Vec3::Zero();  // m
  // A client's impulse acts at the start of so many ticks in a row, which is a force; the first is `tick`.
  Tick ticks = 1;
  bool again = false;  // this is not the first of them
  std::shared_ptr<const BodySpec> spawn;
  std::shared_ptr<const LayoutChange> layout;

  bool over_area() const { return area.radius > 0; }

  friend bool operator<(const Input& x, const Input& y) {
    if (x.tick != y.tick) return x.tick < y.tick;
    if (x.source != y.source) return x.source < y.source;
    return x.sequence < y.sequence;
  }
};

// Which input: its source and sequence.
using InputName = std::pair<uint64_t, uint64_t>;

// The part of a world that is the same in every region and never changes owner.
struct Environment {
  Vec3 gravity = {0, -9.81, 0};
  int64_t tick_us = 16000;      // length of a tick
  double speed_limit = 0;       // m/s; > 0: linear speeds are clamped to it in every step, as a rule of the world (R11)
  double sleep_after = 0.4;     // s below the sleeping speeds before an island sleeps (the paper's section 4.2)
  double sleep_linear = 0.8;    // m/s
  double sleep_angular = 1.0;   // rad/s
  int iterations = 10;          // of the solver
  std::vector<BodySpec> fixed;  // static and kinematic bodies, in every region

  double dt() const { return static_cast<double>(tick_us) * 1e-6; }
};

}  // namespace aureole
