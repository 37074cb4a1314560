// The client library of Aureole: a live copy of a world that many servers simulate, and a way to act on it.
//
// Connect to any region server. The client finds the others, keeps one stream to each, merges what they tell, goes on
// after lost connections, and sends inputs that act exactly once. Bodies change servers without anybody noticing, and
// so do servers come, go, and come back elsewhere: as long as one that the client knows answers, it finds the others.
//
//   std::unique_ptr<aureole::client::Client> client;
//   aureole::client::Status s = aureole::client::Client::Connect("127.0.0.1:40001", &client);
//   if (!s.ok()) ...
//   client->Watch({});
//   while (drawing) {
//     client->Sample(&bodies);  // interpolated, for now
//     for (const aureole::client::Body& b : bodies) Draw(b, *client->LookOf(b.id));
//   }
//
// SI units; one right-handed frame, y up; orientations are unit quaternions. All functions may be called from any
// thread; none but those with a timeout waits for the network.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace aureole::client {

struct Vec3 {
  double x = 0, y = 0, z = 0;
};

struct Quaternion {
  double x = 0, y = 0, z = 0, w = 1;
};

// What became of a call. `code` is gRPC's (0: fine); `reason` one of the names in proto/README.md, or empty; `field`
// the path of the field that was wrong.
struct Status {
  int code = 0;
  std::string message, reason, field;
  bool ok() const { return code == 0; }
};

struct Shape {
  enum class Kind { kSphere, kBox, kCapsule, kCylinder, kHull, kCompound, kPlane, kMesh, kHeightfield };
  Kind kind = Kind::kSphere;
  double radius = 0, height = 0;  // capsules and cylinders: along y, caps included
  Vec3 size;                      // boxes: full edges
  std::vector<Vec3> points;       // hulls
  struct Child;
  std::vector<Child> children;  // compounds
};
struct Shape::Child {
  Vec3 position;
  Quaternion orientation;
  Shape shape;
};

// What stays the same in a body's life.
struct Look {
  Shape shape;
  double mass = 0;  // kg
};

struct Body {
  uint64_t id = 0;
  Vec3 position;  // of the centre of mass
  Quaternion orientation;
  Vec3 velocity, angular_velocity;  // when they were asked for
  int region = -1;                  // whose server tells it
  bool asleep = false;
};

struct Sphere {
  Vec3 centre;
  double radius = 0;
};

struct Rect {  // in x and z
  double min_x = 0, max_x = 0, min_z = 0, max_z = 0;
};

enum class Precision { kFine, kCoarse, kExact };  // 0.5 mm and 0.05 degrees; 7 mm and 0.4 degrees; doubles

struct WatchOptions {
  // What is in view, in whole cells of 32 m; neither: everything.
  std::optional<Rect> rect;
  std::optional<Sphere> sphere;
  double rate = 30;        // frames per second
  double full_within = 0;  // m from the middle of the view; further cells come less often; 0: all come always
  // These stay as they are in the first call.
  Precision precision = Precision::kFine;
  bool velocities = true;
};

struct World {
  std::string name;
  double tick_seconds = 0;
  struct Region {
    std::string endpoint;  // empty: it has left, and its rectangle is no area
    Rect rect;             // outer edges are infinite
  };
  std::vector<Region> regions;  // as Body::region counts them; the list only grows
  uint64_t layout_epoch = 0;    // grows when regions have come or gone, or have other rectangles
};

// One push; exactly one of an impulse, a change of velocity and a force.
struct Push {
  uint64_t body = 0;             // or a sphere
  std::optional<Sphere> sphere;  // every body in it
  double outward = 0;            // with a sphere: away from its centre, in the unit of the kind
  bool fades = false;            // outward falls off to 0 at the radius
  enum class Kind { kImpulse, kVelocityChange, kForce };
  Kind kind = Kind::kImpulse;
  Vec3 linear, angular;            // N s and N m s; m/s and rad/s; N and N m
  double seconds = 0;              // of a force
  std::optional<Vec3> point;       // in the world, where an impulse or a force acts
  std::optional<Vec3> body_point;  // or in the body's frame
};

struct NewBody {
  Shape shape;      // sphere, box, capsule, cylinder, hull
  double mass = 1;  // kg
  Vec3 position;
  Quaternion orientation;
  Vec3 velocity, angular_velocity;
};

// What became of pushes.
struct PushCounts {
  int64_t applied = 0;                                   // on a body at least
  int64_t bodies = 0;                                    // on which they acted
  int64_t rejected = 0;                                  // for good
  int64_t waiting = 0;                                   // not known yet
  std::vector<std::pair<std::string, int64_t>> reasons;  // of the rejected ones
};

// What a ray hits first.
struct RayHit {
  uint64_t body = 0;    // 0: nothing
  bool fixed = false;   // it is static or follows a script
  double distance = 0;  // m
  Vec3 point, normal;   // m; out of the body
};

// What a server may want of its clients.
struct Access {
  std::string tls_ca;  // PEM, the authority of the servers' certificates; empty: plain text
  std::string token;   // empty: none. It is sent over TLS, or within this machine, only
};

struct Counts {
  int64_t frames = 0, bytes = 0;
  int64_t connections = 0, lost_connections = 0;
};

class Client {
 public:
  // Asks `server` (host:port of any region server) for the world. DEADLINE_EXCEEDED (4) or UNAVAILABLE (14) when it
  // does not answer in time; UNAUTHENTICATED (16) or PERMISSION_DENIED (7) when it wants another token. `access` holds
  // for all servers of the world.
  static Status Connect(const std::string& server, std::unique_ptr<Client>* client, double timeout_seconds = 5,
                        const Access& access = {});
  // Ends all streams. Inputs that were not flushed may or may not act.
  ~Client();

  // As it is now: regions and the epoch change while the world runs, the rest never does.
  World world() const;

  // Begins to watch, or changes what is in view, with the next frames. INVALID_ARGUMENT (3) for values that cannot be.
  Status Watch(const WatchOptions& options);
  // Waits until everything in view is known of all regions that there are then; false after the timeout.
  bool WaitUntilComplete(double timeout_seconds) const;

  // The newest state of every body in view, ascending by id. `tick`: the oldest of the last ticks of the servers that
  // there are now.
  void Latest(std::vector<Body>* bodies, int64_t* tick = nullptr) const;
  // As Latest, but all at one simulated time: that of the servers now, less `delay_seconds`, interpolated between what
  // was told and extrapolated for at most 0.25 s. With a delay of two frames it is smooth.
  void Sample(std::vector<Body>* bodies, double delay_seconds = 0.07) const;
  // Of a body in view; nothing when it is in view no more.
  std::optional<Look> LookOf(uint64_t body) const;
  // Simulated time per wall time, as the slowest of the servers that there are now tells it.
  double real_time_factor() const;
  Counts counts() const;

  // Takes a push, which will act once. Pushes go in the order of the calls.
  void Do(const Push& push);
  // Waits until it is known what became of all pushes so far. DEADLINE_EXCEEDED (4): not of all of them.
  Status Flush(double timeout_seconds, PushCounts* counts = nullptr);
  PushCounts pushes() const;
  // `ids`: one per body, 0 for one that was not added.
  Status Spawn(const std::vector<NewBody>& bodies, std::vector<uint64_t>* ids, double timeout_seconds = 10);
  // In the servers' newest states. UNAVAILABLE (14) when one of them does not answer in time.
  Status CastRay(const Vec3& origin, const Vec3& direction, double length, RayHit* hit, double timeout_seconds = 2);
  Status Remove(const std::vector<uint64_t>& bodies, int64_t* removed = nullptr, double timeout_seconds = 10);

 private:
  struct Impl;
  explicit Client(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace aureole::client
