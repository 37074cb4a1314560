#include "server/core/toy_engine.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>
#include <type_traits>

#include "server/core/check.h"

namespace aureole {
namespace {

constexpr double kSleepSpeed = 0.25;  // m/s
constexpr int kSleepTicks = 20;
constexpr int kPasses = 24;        // of the contact solver
constexpr double kMemory = 0.5;    // of a pair's remembered impulse, per tick
constexpr double kTangent = 1e-3;  // share of the remembered impulse that acts sideways
constexpr uint64_t kMagic = 0x31594f5441ull;

struct Body {
  BodyId id;
  double position[3], velocity[3], half[3];
  double mass;
  int64_t slow;    // ticks below the sleeping speed
  int64_t asleep;  // 0 or 1
};
struct Pair {
  BodyId a, b;  // a < b
  double memory;
};
struct Joint {
  JointId id;
  BodyId a, b;
  double strain;
};
struct Header {
  uint64_t magic, bodies, pairs, joints;
};
static_assert(std::is_trivially_copyable_v<Body> && std::is_trivially_copyable_v<Pair> &&
              std::is_trivially_copyable_v<Joint>);

uint64_t Mix(uint64_t h, double v) {
  uint64_t x;
  std::memcpy(&x, &v, sizeof x);
  h = (h ^ x) * 0x9e3779b97f4a7c15ull;
  return h ^ (h >> 29);
}

Vec3 ToVec(const double* v) { return {v[0], v[1], v[2]}; }

Vec3 HalfExtents(const Shape& s) {
  switch (s.kind) {
    case ShapeKind::kSphere:
      return Vec3::Constant(s.radius);
    case ShapeKind::kCapsule:
    case ShapeKind::kCylinder:
      return {s.radius, s.half.y(), s.radius};
    default:
      return s.half;
  }
}

class ToyEngine final : public Engine {
 public:
  explicit ToyEngine(std::shared_ptr<const Environment> environment) : environment_(std::move(environment)) {
    for (const BodySpec& b : environment_->fixed) {
      if (b.shape->kind == ShapeKind::kPlane && b.shape->normal.y() > 0.99) {
        floor_ = std::max(floor_, b.position.y() + b.shape->offset);
      }
    }
  }

  void Spawn(const BodySpec& s) override {
    Body b{};
    b.id = s.id;
    const Vec3 half = HalfExtents(*s.shape);
    for (int i = 0; i < 3; ++i) {
      b.position[i] = s.position[i];
      b.velocity[i] = s.velocity[i];
      b.half[i] = half[i];
    }
    b.mass = s.mass;
    b.asleep = s.asleep;
    Clamp(b);
    Insert(b);
  }

  void Join(const JointSpec& j) override {
    AUREOLE_CHECK(Contains(j.a) && Contains(j.b), "joint %llu", static_cast<unsigned long long>(j.id));
    joints_.push_back({j.id, j.a, j.b, 0});
    SortJoints();
  }

  void Apply(const Input& in) override {
    if (in.kind == Input::Kind::kSpawn) return Spawn(*in.spawn);
    Body& b = At(in.body);
    if (in.kind == Input::Kind::kRemove) {
      Wake(b);
      std::vector<BodyId> touching;
      Query(BoxOf(b), &touching);
      for (BodyId t : touching) Wake(At(t));
      for (const Joint& j : joints_) {
        if (j.a == in.body) Wake(At(j.b));
        if (j.b == in.body) Wake(At(j.a));
      }
      Erase(in.body);
      return;
    }
    for (int i = 0; i < 3; ++i) {
      const double mass = in.kind == Input::Kind::kImpulse ? b.mass : 1;
      b.velocity[i] = in.kind == Input::Kind::kVelocity ? in.linear[i] : b.velocity[i] + in.linear[i] / mass;
    }
    Wake(b);
    Clamp(b);
  }

  void Step(Tick) override {
    FindPairs();
    Collide();
    for (Joint& j : joints_) {
      Body &a = At(j.a), &b = At(j.b);
      if (a.asleep != b.asleep) {
        Wake(a);
        Wake(b);
      }
      for (int i = 0; i < 3; ++i) {
        const double common = (a.velocity[i] * a.mass + b.velocity[i] * b.mass) / (a.mass + b.mass);
        j.strain += 1e-3 * (a.velocity[i] - b.velocity[i]);
        a.velocity[i] = common + 1e-3 * j.strain / a.mass;
        b.velocity[i] = common - 1e-3 * j.strain / b.mass;
      }
    }
    for (Body& b : bodies_) Integrate(b);
  }

  bool Contains(BodyId id) const override { return Find(id) != bodies_.end(); }

  BodyView View(BodyId id) const override {
    const Body& b = At(id);
    BodyView v;
    v.id = id;
    v.box = BoxOf(b);
    v.centre = ToVec(b.position);
    v.radius = std::max({b.half[0], b.half[1], b.half[2]});
    v.velocity = ToVec(b.velocity);
    v.mass = b.mass;
    v.least_inertia = b.mass;  // it does not turn
    v.energy = b.asleep != 0 ? 0 : 0.5 * b.mass * v.velocity.squaredNorm();
    v.asleep = b.asleep != 0;
    return v;
  }

  BodyPose Pose(BodyId id) const override { return PoseOf(At(id)); }

  BodyLook Look(BodyId id) const override {
    const Body& b = At(id);
    auto shape = std::make_shared<Shape>();
    shape->kind = ShapeKind::kBox;
    shape->half = ToVec(b.half);
    return {std::move(shape), b.mass, {}};
  }

  void AppendAwake(std::vector<BodyPose>* out) const override {
    for (BodyId id : Ids()) {
      if (At(id).asleep == 0) out->push_back(PoseOf(At(id)));
    }
  }

  void AppendPoses(const Box& box, std::vector<BodyPose>* out) const override {
    std::vector<BodyId> ids;
    Query(box, &ids);
    for (BodyId id : ids) out->push_back(PoseOf(At(id)));
  }

  int64_t CountAwake() const override { return Counts().awake; }

  std::optional<RayHit> CastRay(const Vec3& from, const Vec3& to) const override {
    std::optional<RayHit> nearest;
    const Vec3 way = to - from;
    for (const Body& b : bodies_) {
      const Box box = BoxOf(b);
      double enter = 0, leave = 1;
      Vec3 normal = Vec3::UnitY();
      for (int i = 0; i < 3; ++i) {
        const double x = (box.min[i] - from[i]) / way[i], y = (box.max[i] - from[i]) / way[i];
        if (way[i] == 0 && (from[i] < box.min[i] || from[i] > box.max[i])) leave = -1;
        if (way[i] == 0) continue;
        if (std::min(x, y) > enter) {
          enter = std::min(x, y);
          normal = way[i] > 0 ? Vec3(-Vec3::Unit(i)) : Vec3(Vec3::Unit(i));
        }
        leave = std::min(leave, std::max(x, y));
      }
      if (enter > leave || (nearest.has_value() && enter >= nearest->fraction)) continue;
      nearest = RayHit{b.id, false, enter, normal};
    }
    return nearest;
  }

  void NoteSleep(bool on) override {
    note_sleep_ = on;
    slept_.clear();
    woke_.clear();
  }
  void TakeSleep(std::vector<BodyId>* slept, std::vector<BodyId>* woke) override {
    slept->insert(slept->end(), slept_.begin(), slept_.end());
    woke->insert(woke->end(), woke_.begin(), woke_.end());
    slept_.clear();
    woke_.clear();
  }

  uint64_t Hash(BodyId id) const override {
    const Body& b = At(id);
    uint64_t h = static_cast<uint64_t>(b.slow * 2 + b.asleep);
    for (int i = 0; i < 3; ++i) h = Mix(Mix(h, b.position[i]), b.velocity[i]);
    return h;
  }

  void Jointed(BodyId id, std::vector<BodyId>* out) const override {
    const size_t from = out->size();
    for (const Joint& j : joints_) {
      if (j.a == id) out->push_back(j.b);
      if (j.b == id) out->push_back(j.a);
    }
    std::sort(out->begin() + static_cast<std::ptrdiff_t>(from), out->end());
  }

  std::vector<BodyId> Ids() const override {
    std::vector<BodyId> ids;
    for (const Body& b : bodies_) ids.push_back(b.id);
    return ids;
  }

  void CollectOutside(const Rect& interior, double margin, std::vector<BodyId>* out) const override {
    for (const Body& b : bodies_) {
      if (!interior.Encloses(BoxOf(b), margin)) out->push_back(b.id);
    }
  }

  void Query(const Box& box, std::vector<BodyId>* out) const override {
    for (const Body& b : bodies_) {
      if (Overlap(BoxOf(b), box)) out->push_back(b.id);
    }
  }

  double MaxRadius() const override { return max_radius_; }

  void SaveTo(std::span<const BodyId> ids, std::string* bytes) const override {
    const size_t begin = bytes->size();
    bytes->resize(begin + sizeof(Header));
    auto append = [bytes](const auto& v) { bytes->append(reinterpret_cast<const char*>(&v), sizeof v); };
    auto in = [ids](BodyId id) { return std::binary_search(ids.begin(), ids.end(), id); };
    Header h{kMagic, ids.size(), 0, 0};
    for (BodyId id : ids) append(At(id));
    for (const auto& [key, memory] : memory_) {
      if (!in(key.first) && !in(key.second)) continue;
      if (!in(key.first) || !in(key.second)) continue;  // a pair that has come apart: forgotten in the next step
      append(Pair{key.first, key.second, memory});
      ++h.pairs;
    }
    for (const Joint& j : joints_) {
      if (!in(j.a) && !in(j.b)) continue;
      AUREOLE_CHECK(in(j.a) && in(j.b), "joint %llu would be cut", static_cast<unsigned long long>(j.id));
      append(j);
      ++h.joints;
    }
    std::memcpy(bytes->data() + begin, &h, sizeof h);
  }

  std::string Extract(std::span<const BodyId> ids) override {
    std::string bytes = Save(ids);
    for (BodyId id : ids) Erase(id);
    return bytes;
  }

  absl::Status Restore(std::string_view bytes) override {
    Header h;
    if (bytes.size() < sizeof h) return absl::InvalidArgumentError("state: truncated");
    std::memcpy(&h, bytes.data(), sizeof h);
    const size_t limit = bytes.size();
    if (h.magic != kMagic || h.bodies > limit || h.pairs > limit || h.joints > limit ||
        bytes.size() != sizeof h + h.bodies * sizeof(Body) + h.pairs * sizeof(Pair) + h.joints * sizeof(Joint)) {
      return absl::InvalidArgumentError("state: is not a toy engine's");
    }
    const char* at = bytes.data() + sizeof h;
    std::vector<Body> bodies(h.bodies);
    std::vector<Pair> pairs(h.pairs);
    std::vector<Joint> joints(h.joints);
    auto take = [&at](auto& v) {
      if (!v.empty()) std::memcpy(v.data(), at, v.size() * sizeof v[0]);
      at += v.size() * sizeof v[0];
    };
    take(bodies);
    take(pairs);
    take(joints);
    for (const Body& b : bodies) {
      if (Contains(b.id)) return absl::InvalidArgumentError("state: a body is already here");
    }
    for (const Body& b : bodies) Insert(b);
    for (const Pair& p : pairs) memory_[{p.a, p.b}] = p.memory;
    joints_.insert(joints_.end(), joints.begin(), joints.end());
    SortJoints();
    return absl::OkStatus();
  }

  std::unique_ptr<Engine> Scratch() const override { return std::make_unique<ToyEngine>(environment_); }

  EngineCounts Counts() const override {
    EngineCounts c;
    c.bodies = static_cast<int64_t>(bodies_.size());
    for (const Body& b : bodies_) c.awake += b.asleep == 0;
    c.contacts = static_cast<int64_t>(memory_.size());
    return c;
  }

 private:
  static BodyPose PoseOf(const Body& b) {
    return {b.id, ToVec(b.position), Quat::Identity(), ToVec(b.velocity), Vec3::Zero(), b.asleep != 0};
  }
  static Box BoxOf(const Body& b) { return {ToVec(b.position) - ToVec(b.half), ToVec(b.position) + ToVec(b.half)}; }
  std::vector<Body>::const_iterator Find(BodyId id) const {
    auto it = std::lower_bound(bodies_.begin(), bodies_.end(), id, [](const Body& b, BodyId i) { return b.id < i; });
    return it != bodies_.end() && it->id == id ? it : bodies_.end();
  }
  const Body& At(BodyId id) const {
    auto it = Find(id);
    AUREOLE_CHECK(it != bodies_.end(), "no body %llu", static_cast<unsigned long long>(id));
    return *it;
  }
  Body& At(BodyId id) { return const_cast<Body&>(std::as_const(*this).At(id)); }
  void Insert(const Body& b) {
    auto it = std::lower_bound(bodies_.begin(), bodies_.end(), b.id, [](const Body& x, BodyId i) { return x.id < i; });
    AUREOLE_CHECK(it == bodies_.end() || it->id != b.id, "body %llu is here", static_cast<unsigned long long>(b.id));
    bodies_.insert(it, b);
    max_radius_ = std::max({max_radius_, b.half[0], b.half[1], b.half[2]});
  }
  void Erase(BodyId id) {
    bodies_.erase(Find(id));
    std::erase_if(memory_, [id](const auto& e) { return e.first.first == id || e.first.second == id; });
    std::erase_if(joints_, [id](const Joint& j) { return j.a == id || j.b == id; });
  }
  void SortJoints() {
    std::sort(joints_.begin(), joints_.end(), [](const Joint& x, const Joint& y) { return x.id < y.id; });
  }
  void Wake(Body& b) {
    if (note_sleep_ && b.asleep != 0) woke_.push_back(b.id);
    b.asleep = b.slow = 0;
  }
  void Clamp(Body& b) const {
    const double limit = environment_->speed_limit;
    if (limit <= 0) return;
    const double s = ToVec(b.velocity).norm();
    if (s > limit) {
      for (double& v : b.velocity) v *= limit / s * (1 - 1e-12);
    }
  }

  void FindPairs() {
    order_.clear();
    for (size_t i = 0; i < bodies_.size(); ++i) order_.push_back(static_cast<int>(i));
    std::sort(order_.begin(), order_.end(), [this](int x, int y) {
      const double a = bodies_[x].position[0] - bodies_[x].half[0], b = bodies_[y].position[0] - bodies_[y].half[0];
      return a != b ? a < b : x < y;
    });
    pairs_.clear();
    for (size_t i = 0; i < order_.size(); ++i) {
      const Box box = BoxOf(bodies_[order_[i]]);
      for (size_t j = i + 1; j < order_.size(); ++j) {
        const Box other = BoxOf(bodies_[order_[j]]);
        if (other.min.x() > box.max.x()) break;
        if (Overlap(box, other)) pairs_.push_back(std::minmax(order_[i], order_[j]));
      }
    }
    std::sort(pairs_.begin(), pairs_.end());  // bodies_ is sorted by id, so this is the order of ids
    std::map<std::pair<BodyId, BodyId>, double> kept;
    for (auto [i, j] : pairs_) {
      const std::pair<BodyId, BodyId> key{bodies_[i].id, bodies_[j].id};
      auto it = memory_.find(key);
      kept.emplace_hint(kept.end(), key, it == memory_.end() ? 0 : it->second * kMemory);
    }
    memory_ = std::move(kept);
  }

  void Collide() {
    for (int pass = 0; pass < kPasses; ++pass) {
      bool changed = false;
      auto memory = memory_.begin();  // same order as pairs_
      for (auto [i, j] : pairs_) {
        changed |= CollidePair(bodies_[i], bodies_[j], &memory->second);
        ++memory;
      }
      if (!changed) break;
    }
  }

  bool CollidePair(Body& a, Body& b, double* memory) {
    bool changed = false;
    if (a.asleep != b.asleep) {
      Wake(a);
      Wake(b);
      changed = true;
    }
    int axis = 0;
    double gap = -1e300;
    for (int i = 0; i < 3; ++i) {
      const double g = std::fabs(a.position[i] - b.position[i]) - a.half[i] - b.half[i];
      if (g > gap) {
        gap = g;
        axis = i;
      }
    }
    const double side = b.position[axis] >= a.position[axis] ? 1 : -1;
    const double approach = (b.velocity[axis] - a.velocity[axis]) * side;
    if (approach >= 0) return changed;
    const double impulse = -2 * approach * a.mass * b.mass / (a.mass + b.mass) * side;
    a.velocity[axis] -= impulse / a.mass;
    b.velocity[axis] += impulse / b.mass;
    *memory += impulse;
    const int tangent = axis == 0 ? 2 : 0;
    a.velocity[tangent] -= kTangent * *memory / a.mass;
    b.velocity[tangent] += kTangent * *memory / b.mass;
    return true;
  }

  void Integrate(Body& b) {
    if (b.asleep) return;
    const double dt = environment_->dt();
    for (int i = 0; i < 3; ++i) b.velocity[i] += environment_->gravity[i] * dt;
    Clamp(b);
    for (int i = 0; i < 3; ++i) b.position[i] += b.velocity[i] * dt;
    if (b.position[1] - b.half[1] < floor_) {
      b.position[1] = floor_ + b.half[1];
      b.velocity[1] = 0;
      b.velocity[0] *= 0.98;
      b.velocity[2] *= 0.98;
    }
    if (ToVec(b.velocity).norm() >= kSleepSpeed) {
      b.slow = 0;
    } else if (++b.slow >= kSleepTicks) {
      b.asleep = 1;
      if (note_sleep_) slept_.push_back(b.id);
      std::fill(b.velocity, b.velocity + 3, 0.0);
    }
  }

  std::shared_ptr<const Environment> environment_;
  double floor_ = -1e300;
  bool note_sleep_ = false;
  std::vector<BodyId> slept_, woke_;
  double max_radius_ = 0;
  std::vector<Body> bodies_;  // ascending by id
  std::vector<Joint> joints_;
  std::map<std::pair<BodyId, BodyId>, double> memory_;  // of touching pairs
  std::vector<std::pair<int, int>> pairs_;
  std::vector<int> order_;
};

}  // namespace

std::unique_ptr<Engine> MakeToyEngine(const Environment& environment) {
  return std::make_unique<ToyEngine>(std::make_shared<const Environment>(environment));
}

}  // namespace aureole
