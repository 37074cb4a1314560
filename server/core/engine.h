// The physics engine as the protocol needs it. Two implementations: ToyEngine (fast, for the cluster simulation) and
// BulletEngine (server/physics).
//
// Determinism contract. The result of Step for a contact component (bodies joined by overlapping exact boxes or by
// joints) is a pure function of that component's own state, of the environment and of the tick: neither bodies outside
// of it, nor creation order, nor the history of Extract and Restore may change a bit (EXACT.md). Nothing is promised
// between two machines that run different binaries.
//
// One thread at a time; no call blocks. A broken precondition stops the process.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <absl/status/status.h>

#include "server/core/scene.h"
#include "server/core/types.h"

namespace aureole {

// What the protocol knows of one body.
struct BodyView {
  BodyId id = 0;
  Box box;                   // the exact box that the next Step's contact filter uses (breaking margin included)
  Vec3 centre;               // centre of mass
  double radius = 0;         // of the sphere about `centre` that bounds `box` in every orientation of the body
  Vec3 velocity;             // m/s
  double mass = 0;           // kg
  double least_inertia = 0;  // the smallest principal moment, kg m^2
  double energy = 0;         // kinetic, of turning too, J; 0 when asleep
  bool asleep = false;

  template <class Archive>
  void Visit(Archive& a) {
    a(id, box, centre, radius, velocity, mass, least_inertia, energy, asleep);
  }
};

// Where an observer sees one body.
struct BodyPose {
  BodyId id = 0;
  Vec3 position;  // of the centre of mass
  Quat orientation = Quat::Identity();
  Vec3 velocity;          // m/s
  Vec3 angular_velocity;  // rad/s
  bool asleep = false;
};

// What stays the same in a body's life.
struct BodyLook {
  std::shared_ptr<const Shape> shape;
  double mass = 0;  // kg
  Material material;
};

// Where a ray meets a body first.
struct RayHit {
  BodyId id = 0;
  bool fixed = false;   // static or kinematic
  double fraction = 0;  // of the way from the ray's begin to its end
  Vec3 normal = Vec3::UnitY();
};

struct EngineCounts {
  int64_t bodies = 0;  // dynamic
  int64_t awake = 0;
  int64_t contacts = 0;  // contact points
};

class Engine {
 public:
  virtual ~Engine() = default;

  // Adds a dynamic body that is not there yet.
  virtual void Spawn(const BodySpec& body) = 0;
  // Adds a joint whose bodies are here.
  virtual void Join(const JointSpec& joint) = 0;
  // Applies one input to bodies that are here (a spawn's body must not be). Inputs of a tick come in their order.
  virtual void Apply(const Input& input) = 0;

  // Simulates tick `n`, from state n-1 to state n. Kinematic bodies move from their script's pose at n-1 to that at n.
  virtual void Step(Tick n) = 0;

  virtual bool Contains(BodyId id) const = 0;
  // Precondition of the five below: Contains(id).
  virtual BodyView View(BodyId id) const = 0;
  virtual BodyPose Pose(BodyId id) const = 0;
  virtual BodyLook Look(BodyId id) const = 0;
  // Of everything that decides the body's future: pose, velocities, sleep state and timer. Equal states, equal hashes.
  virtual uint64_t Hash(BodyId id) const = 0;
  // Bodies that share a joint with it, ascending, appended.
  virtual void Jointed(BodyId id, std::vector<BodyId>* out) const = 0;

  // Ids of all dynamic bodies, ascending. Linear; for hashes and snapshots, not for the tick.
  virtual std::vector<BodyId> Ids() const = 0;
  // Dynamic bodies whose exact box is not wholly inside `interior` shrunk by `margin`, ascending, appended. Costs a
  // few comparisons per awake body; sleeping bodies inside cost nothing.
  virtual void CollectOutside(const Rect& interior, double margin, std::vector<BodyId>* out) const = 0;
  // Dynamic bodies whose exact box meets `box`, ascending, appended. Costs O(log bodies + hits).
  virtual void Query(const Box& box, std::vector<BodyId>* out) const = 0;
  // For observers: poses of the dynamic bodies that are awake, and of those that Query finds; ascending ids, appended.
  virtual void AppendAwake(std::vector<BodyPose>* out) const = 0;
  virtual void AppendPoses(const Box& box, std::vector<BodyPose>* out) const = 0;
  virtual int64_t CountAwake() const = 0;  // constant time
  // The nearest body on the way, static and kinematic ones too; nothing when there is none.
  virtual std::optional<RayHit> CastRay(const Vec3& from, const Vec3& to) const = 0;
  // From here on, bodies that fall asleep or wake up are noted; and those noted since the last call, appended in no
  // order.
  virtual void NoteSleep(bool on) = 0;
  virtual void TakeSleep(std::vector<BodyId>* slept, std::vector<BodyId>* woke) = 0;
  // Largest BodyView::radius of any body that ever was here.
  virtual double MaxRadius() const = 0;

  // The whole state of these bodies (ascending ids): description, pose, velocities, sleep timer, forces, cached contact
  // points among them, joints among them. A set must be closed under joints and overlapping boxes. Extract also removes
  // them, without waking anybody (P59). SaveTo appends.
  virtual void SaveTo(std::span<const BodyId> ids, std::string* out) const = 0;
  std::string Save(std::span<const BodyId> ids) const {
    std::string out;
    SaveTo(ids, &out);
    return out;
  }
  virtual std::string Extract(std::span<const BodyId> ids) = 0;
  // Adds what Save or Extract wrote. InvalidArgument when the bytes are not such a state, or a body is already here;
  // then nothing has changed.
  virtual absl::Status Restore(std::string_view state) = 0;

  // An engine of the same kind and environment without dynamic bodies; shares what is immutable. Used to step a cluster
  // on its own.
  virtual std::unique_ptr<Engine> Scratch() const = 0;

  virtual EngineCounts Counts() const = 0;
};

}  // namespace aureole
