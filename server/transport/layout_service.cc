#include "server/transport/layout_service.h"

#include <utility>

#include <absl/strings/str_cat.h>

#include "server/transport/error_status.h"
#include "server/transport/message_stream.h"

namespace aureole {

// One call. What it could not take in time is replaced by what is newer.
class LayoutService::Stream final : public MessageStream<v1::LayoutUpdate> {
 public:
  Stream(LayoutService* service, grpc::CallbackServerContext* context, const v1::WatchLayoutRequest& request)
      : MessageStream(&service->mutex_, context),
        service_(service),
        auras_(request.auras() && !request.layout_only()),
        siblings_(request.layout_only() ? &service->layout_only_ : &service->streams_) {
    siblings_->insert(this);
    service_->want_auras_ += auras_ ? 1 : 0;
  }

  bool auras() const { return auras_; }

  void Offer(const v1::RegionStatus& status) {
    if (ended()) return;
    *next_.mutable_status() = status;
    waiting_ = true;
    Continue();
  }
  void OfferWorld(const v1::GetWorldResponse& world) {
    *next_.mutable_world() = world;
    waiting_ = true;
    Continue();
  }

 private:
  bool Next(v1::LayoutUpdate* out) override {
    if (!std::exchange(waiting_, false)) return false;
    *out = std::exchange(next_, {});
    return true;
  }
  void Leave() override {
    siblings_->erase(this);
    service_->want_auras_ -= auras_ ? 1 : 0;
  }

  LayoutService* const service_;
  const bool auras_;
  std::set<Stream*>* const siblings_;
  v1::LayoutUpdate next_;
  bool waiting_ = false;  // next_ is something
};

grpc::ServerWriteReactor<v1::LayoutUpdate>* LayoutService::Watch(grpc::CallbackServerContext* context,
                                                                 const v1::WatchLayoutRequest& request) {
  const std::lock_guard lock(mutex_);
  auto* stream = new Stream(this, context, request);
  if (!serving_) {
    stream->End(NoRegion());
  } else if (streams_.size() > kMostStreams) {
    stream->End(Refusal(grpc::StatusCode::RESOURCE_EXHAUSTED, v1::BUSY, "",
                        absl::StrCat("the server tells its status to at most ", kMostStreams,
                                     " clients; try later, or set layout_only")));
  } else if (layout_only_.size() > kMostLayoutOnly) {
    stream->End(
        Refusal(grpc::StatusCode::RESOURCE_EXHAUSTED, v1::BUSY, "",
                absl::StrCat("the server tells its layout to at most ", kMostLayoutOnly, " clients; ask another")));
  } else {
    stream->OfferWorld(world_);
  }
  return stream;
}

void LayoutService::Serve(const v1::GetWorldResponse& world) {
  const std::lock_guard lock(mutex_);
  serving_ = true;
  world_ = world;
}

void LayoutService::Follow(const v1::GetWorldResponse& world) {
  const std::lock_guard lock(mutex_);
  world_ = world;
  for (const auto* streams : {&streams_, &layout_only_}) {
    for (Stream* s : *streams) s->OfferWorld(world_);
  }
}

void LayoutService::Stop() {
  const std::lock_guard lock(mutex_);
  serving_ = false;
  for (const auto* streams : {&streams_, &layout_only_}) {
    for (Stream* s : *streams) s->End(RegionGivenUp());
  }
}

void LayoutService::AfterTick(const Region& region) {
  if (want_auras_ == 0) return auras_.clear();
  const Clock::time_point now = Clock::now();
  if (now - auras_at_ < kAuraEvery) return;
  auras_at_ = now;
  auras_.clear();
  region.AppendAuras(kMostAuras, &auras_);
}

void LayoutService::Report(const v1::Report& report, int64_t clients, int64_t client_bytes_sent) {
  const std::lock_guard lock(mutex_);
  if (streams_.empty()) return;
  v1::RegionStatus status;
  status.set_region(world_.region());
  status.set_tick(report.tick());
  status.set_bodies(report.bodies());
  status.set_awake(report.awake());
  status.set_real_time_factor(report.real_time_factor());
  status.set_frame_mean_ms(report.frame().mean_ms());
  status.set_frame_p99_ms(report.frame().p99_ms());
  status.set_frame_max_ms(report.frame().max_ms());
  status.set_auras(report.auras_told());
  status.set_transfers(report.transfers());
  status.set_bodies_moved(report.bodies_moved());
  status.set_bytes_sent(report.bytes_sent());
  status.set_client_bytes_sent(client_bytes_sent);
  status.set_clients(clients);
  status.set_violations(report.violations());
  status.set_waits(report.waits());
  status.set_wait_us(report.wait_us());
  *status.mutable_waiting_for() = report.waiting_for();
  v1::RegionStatus with_auras = status;
  for (const WireBox& box : auras_) {
    for (float v : box.min) with_auras.add_aura(v);
    for (float v : box.max) with_auras.add_aura(v);
  }
  for (Stream* s : streams_) s->Offer(s->auras() ? with_auras : status);
}

}  // namespace aureole
