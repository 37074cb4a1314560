#include "server/transport/simulation_service.h"

#include <cmath>
#include <memory>
#include <unordered_set>
#include <utility>
#include <vector>

#include "server/transport/error_status.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;

constexpr double kDefaultRate = 20;
constexpr double kMaxRate = 1000;

void SetVec3(const Vec3& v, v1::Vec3* out) {
  out->set_x(v.x());
  out->set_y(v.y());
  out->set_z(v.z());
}

// A state that is shared by all streams that are due at this tick.
struct Snapshot {
  v1::Replicas columns;  // without shapes
  std::vector<BodyId> ids;
  std::vector<std::shared_ptr<const Shape>> shapes;
};

std::shared_ptr<const Snapshot> TakeSnapshot(const Region& region) {
  auto out = std::make_shared<Snapshot>();
  v1::Replicas& c = out->columns;
  const Engine& engine = region.engine();
  out->ids = engine.Ids();
  out->shapes.reserve(out->ids.size());
  c.set_tick(region.tick());
  c.set_region(region.self());
  BodyId last = 0;
  for (BodyId id : out->ids) {
    const BodyPose pose = engine.Pose(id);
    c.add_id(static_cast<int64_t>(id - std::exchange(last, id)));
    const Eigen::Vector4f turn = pose.orientation.coeffs().cast<float>();
    const Eigen::Vector3f velocity = pose.velocity.cast<float>();
    c.mutable_position()->Add(pose.position.data(), pose.position.data() + 3);
    c.mutable_orientation()->Add(turn.data(), turn.data() + 4);
    c.mutable_velocity()->Add(velocity.data(), velocity.data() + 3);
    c.add_asleep(pose.asleep);
    out->shapes.push_back(pose.shape);
  }
  return out;
}

}  // namespace

v1::Shape ShapeToProto(const Shape& shape) {
  v1::Shape out;
  switch (shape.kind) {
    case ShapeKind::kSphere:
      out.mutable_sphere()->set_radius(shape.radius);
      break;
    case ShapeKind::kBox:
      SetVec3(2 * shape.half, out.mutable_box()->mutable_size());
      break;
    case ShapeKind::kCapsule:
      out.mutable_capsule()->set_radius(shape.radius);
      out.mutable_capsule()->set_height(2 * shape.half.y());
      break;
    case ShapeKind::kCylinder:
      out.mutable_cylinder()->set_radius(shape.radius);
      out.mutable_cylinder()->set_height(2 * shape.half.y());
      break;
    case ShapeKind::kHull:
      for (const Vec3& p : shape.points) SetVec3(p, out.mutable_hull()->add_points());
      break;
    case ShapeKind::kCompound:
      for (const ChildShape& child : shape.children) {
        auto* c = out.mutable_compound()->add_children();
        SetVec3(child.position, c->mutable_position());
        c->mutable_orientation()->set_x(child.orientation.x());
        c->mutable_orientation()->set_y(child.orientation.y());
        c->mutable_orientation()->set_z(child.orientation.z());
        c->mutable_orientation()->set_w(child.orientation.w());
        *c->mutable_shape() = ShapeToProto(*child.shape);
      }
      break;
    case ShapeKind::kPlane:
    case ShapeKind::kMesh:
    case ShapeKind::kHeightfield:
      break;  // never of a dynamic body
  }
  return out;
}

// One StreamReplicas call. Its fields are guarded by the service's mutex; deletes itself.
class SimulationService::Watcher final : public grpc::ServerWriteReactor<v1::Replicas> {
 public:
  // Holds the mutex.
  Watcher(SimulationService* service, double rate)
      : service_(service),
        period_(std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1 / rate))) {}

  bool Due(Clock::time_point now) const { return !writing_ && !ended_ && now >= next_; }

  void Write(const Snapshot& state, Clock::time_point now) {
    // Keeps the rate on average, but never makes up for what the reader was too slow for.
    next_ = std::max(next_ + period_, now);
    out_ = state.columns;
    std::unordered_set<BodyId> seen;
    for (size_t i = 0; i < state.ids.size(); ++i) {
      seen.insert(state.ids[i]);
      if (seen_.contains(state.ids[i])) continue;
      out_.add_shape_of(state.ids[i]);
      *out_.add_shape() = ShapeToProto(*state.shapes[i]);
    }
    seen_ = std::move(seen);
    writing_ = true;
    StartWrite(&out_);
  }

  // No further write; finishes now, or when the write in flight is done.
  void End(const grpc::Status& status) {
    if (ended_) return;
    ended_ = true;
    verdict_ = status;
    if (!writing_) Finish(verdict_);
  }

  void OnWriteDone(bool ok) override {
    const std::lock_guard lock(service_->mutex_);
    writing_ = false;
    if (ended_) {
      Finish(verdict_);
    } else if (!ok) {
      End(grpc::Status::CANCELLED);
    }
  }
  void OnCancel() override {
    const std::lock_guard lock(service_->mutex_);
    End(grpc::Status::CANCELLED);
  }
  void OnDone() override {
    {
      const std::lock_guard lock(service_->mutex_);
      service_->watchers_.erase(this);
      --service_->watching_;
    }
    delete this;
  }

 private:
  SimulationService* const service_;
  const Clock::duration period_;
  Clock::time_point next_ = Clock::time_point::min();
  bool writing_ = false, ended_ = false;
  grpc::Status verdict_;
  std::unordered_set<BodyId> seen_;  // in the message before
  v1::Replicas out_;
};

SimulationService::SimulationService() = default;
SimulationService::~SimulationService() = default;

grpc::ServerUnaryReactor* SimulationService::GetWorld(grpc::CallbackServerContext* context, const v1::GetWorldRequest*,
                                                      v1::GetWorldResponse* response) {
  grpc::ServerUnaryReactor* reactor = context->DefaultReactor();
  const std::lock_guard lock(mutex_);
  if (!serving_) {
    reactor->Finish(NoRegion());
    return reactor;
  }
  *response = world_;
  response->set_tick(tick_);
  response->set_bodies(bodies_);
  reactor->Finish(grpc::Status::OK);
  return reactor;
}

grpc::ServerWriteReactor<v1::Replicas>* SimulationService::StreamReplicas(grpc::CallbackServerContext*,
                                                                          const v1::StreamReplicasRequest* request) {
  const double rate = request->rate() == 0 ? kDefaultRate : request->rate();
  const bool sane = std::isfinite(rate) && rate > 0 && rate <= kMaxRate;
  const std::lock_guard lock(mutex_);
  auto* watcher = new Watcher(this, sane ? rate : kDefaultRate);
  watchers_.insert(watcher);
  ++watching_;
  if (!sane) {
    watcher->End(Refusal(grpc::StatusCode::INVALID_ARGUMENT, v1::BAD_VALUE, "rate",
                         "must be above 0 and at most 1000 per second, or 0 for 20"));
  } else if (!serving_) {
    watcher->End(NoRegion());
  }
  return watcher;
}

grpc::ServerReadReactor<v1::ImpulseBatch>* SimulationService::ApplyImpulses(grpc::CallbackServerContext*,
                                                                            v1::ImpulseSummary* response) {
  return inputs_.ApplyImpulses(response);
}

grpc::ServerUnaryReactor* SimulationService::SpawnBodies(grpc::CallbackServerContext*,
                                                         const v1::SpawnBodiesRequest* request,
                                                         v1::SpawnBodiesResponse* response) {
  return inputs_.SpawnBodies(*request, response);
}

grpc::ServerUnaryReactor* SimulationService::RemoveBodies(grpc::CallbackServerContext*,
                                                          const v1::RemoveBodiesRequest* request,
                                                          v1::RemoveBodiesResponse* response) {
  return inputs_.RemoveBodies(*request, response);
}

void SimulationService::Serve(const v1::Assignment& assignment, const World& world) {
  inputs_.Serve(assignment.world(), world.environment.tick_us);
  const std::lock_guard lock(mutex_);
  serving_ = true;
  world_.Clear();
  world_.set_name(world.name);
  world_.set_tick_us(world.environment.tick_us);
  world_.set_region(assignment.region());
  world_.set_layout_epoch(assignment.layout_epoch());
  *world_.mutable_endpoints() = assignment.endpoints();
  for (RegionId r = 0; r < world.layout.size(); ++r) {
    const Rect& rect = world.layout.rect(r);
    v1::RegionRect* out = world_.add_layout();
    out->set_min_x(rect.min_x);
    out->set_max_x(rect.max_x);
    out->set_min_z(rect.min_z);
    out->set_max_z(rect.max_z);
  }
}

void SimulationService::Stop() {
  inputs_.Stop();
  const std::lock_guard lock(mutex_);
  serving_ = false;
  for (Watcher* w : watchers_) w->End(RegionGivenUp());
}

void SimulationService::Publish(const Region& region, int64_t bodies) {
  tick_ = region.tick();
  bodies_ = bodies;
  if (watching_ == 0) return;
  const Clock::time_point now = Clock::now();
  const auto any_due = [&] {
    const std::lock_guard lock(mutex_);
    return std::any_of(watchers_.begin(), watchers_.end(), [&](const Watcher* w) { return w->Due(now); });
  };
  if (!any_due()) return;
  const std::shared_ptr<const Snapshot> state = TakeSnapshot(region);
  const std::lock_guard lock(mutex_);
  for (Watcher* w : watchers_) {
    if (w->Due(now)) w->Write(*state, now);
  }
}

}  // namespace aureole
