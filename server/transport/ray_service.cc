#include "server/transport/ray_service.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "server/transport/error_status.h"
#include "server/transport/shape_proto.h"

namespace aureole {
namespace {

constexpr limits::Range kLength{0, 1e5, "m"};

}  // namespace

std::vector<ClientRay> ReadRays(const v1::CastRaysRequest& request, SpecCheck* check) {
  const Path path = Path() / "rays";
  std::vector<ClientRay> out;
  if (request.rays_size() == 0) check->Fail(path, "must be at least one", v1::MISSING);
  if (request.rays_size() > RayService::kMostPerCall) {
    check->Fail(path, "must be at most 256; send more calls", v1::TOO_MANY);
  }
  for (int i = 0; i < request.rays_size() && check->ok(); ++i) {
    const auto& ray = request.rays(i);
    const Vec3 from = check->Position(path[i] / "origin", ray.origin());
    const Vec3 direction = check->Direction(path[i] / "direction", ray.direction());
    out.push_back({from, from + direction * check->Positive(kLength, path[i] / "length", ray.length())});
  }
  return out;
}

// One call. Guarded by the service's mutex; deletes itself.
class RayService::Call final : public grpc::ServerUnaryReactor {
 public:
  Call(RayService* service, std::vector<ClientRay> rays, v1::CastRaysResponse* response)
      : service_(service), rays_(std::move(rays)), response_(response) {}

  size_t rays() const { return rays_.size(); }

  void Answer(const Region& region) {
    response_->set_tick(region.tick());
    response_->set_layout_epoch(region.layout_epoch());
    for (const ClientRay& ray : rays_) {
      v1::CastRaysResponse::Hit* out = response_->add_hits();
      const std::optional<RayHit> hit = region.engine().CastRay(ray.from, ray.to);
      if (!hit.has_value()) continue;
      const Vec3 way = (ray.to - ray.from) * hit->fraction;
      out->set_body(hit->id);
      out->set_fixed(hit->fixed);
      out->set_distance(way.norm());
      SetVec3(ray.from + way, out->mutable_point());
      SetVec3(hit->normal, out->mutable_normal());
    }
    End(grpc::Status::OK);
  }

  void End(const grpc::Status& status) {
    if (!std::exchange(ended_, true)) Finish(status);
  }

  void OnCancel() override {
    const std::lock_guard lock(service_->mutex_);
    std::erase(service_->calls_, this);
    End(grpc::Status::CANCELLED);
  }
  void OnDone() override { delete this; }

 private:
  RayService* const service_;
  const std::vector<ClientRay> rays_;
  v1::CastRaysResponse* const response_;
  bool ended_ = false;
};

grpc::ServerUnaryReactor* RayService::Cast(const v1::CastRaysRequest& request, v1::CastRaysResponse* response) {
  SpecCheck check;
  auto* call = new Call(this, ReadRays(request, &check), response);
  const std::lock_guard lock(mutex_);
  if (!serving_) {
    call->End(NoRegion());
  } else if (!check.ok()) {
    call->End(Refusal(check));
  } else {
    calls_.push_back(call);
    asked_ = true;
  }
  return call;
}

void RayService::Serve() {
  const std::lock_guard lock(mutex_);
  serving_ = true;
}

void RayService::Stop() {
  const std::lock_guard lock(mutex_);
  serving_ = false;
  for (Call* c : std::exchange(calls_, {})) c->End(RegionGivenUp());
}

void RayService::Answer(const Region& region) {
  if (!asked_) return;
  const std::lock_guard lock(mutex_);
  size_t rays = 0;
  while (!calls_.empty() && rays < kMostPerTick) {
    Call* call = calls_.front();
    calls_.pop_front();
    rays += call->rays();
    call->Answer(region);
  }
  asked_ = !calls_.empty();
}

}  // namespace aureole
