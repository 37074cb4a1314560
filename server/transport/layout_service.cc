#include "server/transport/layout_service.h"

#include <utility>

#include <absl/strings/str_cat.h>
#include <grpcpp/server_context.h>

#include "server/transport/error_status.h"

namespace aureole {

// One call. Guarded by the service's mutex; deletes itself. One write in flight; what it could not take in time is
// replaced by what is newer.
class LayoutService::Stream final : public grpc::ServerWriteReactor<v1::LayoutUpdate> {
 public:
  Stream(LayoutService* service, grpc::CallbackServerContext* context, bool auras)
      : service_(service), context_(context), auras_(auras) {}

  bool auras() const { return auras_; }

  void Offer(const v1::RegionStatus& status) {
    if (ended_) return;
    *next_.mutable_status() = status;
    waiting_ = true;
    Continue();
  }
  void OfferWorld(const v1::GetWorldResponse& world) {
    *next_.mutable_world() = world;
    waiting_ = true;
    Continue();
  }

  // No further write; finishes now, or when the write in flight is done.
  void End(const grpc::Status& status) {
    if (std::exchange(ended_, true)) return;
    verdict_ = status;
    if (!writing_) Finish(verdict_);
  }

  void OnWriteDone(bool ok) override {
    const std::lock_guard lock(service_->mutex_);
    writing_ = false;
    if (ended_) return Finish(verdict_);
    if (!ok) return End(grpc::Status::CANCELLED);
    Continue();
  }
  void OnCancel() override {
    const std::lock_guard lock(service_->mutex_);
    End(grpc::Status::CANCELLED);
  }
  void OnDone() override {
    {
      const std::lock_guard lock(service_->mutex_);
      service_->streams_.erase(this);
      service_->want_auras_ -= auras_ ? 1 : 0;
    }
    delete this;
  }

 private:
  void Continue() {
    if (writing_ && Clock::now() - written_at_ > kLongestWrite) context_->TryCancel();
    if (writing_ || ended_ || !waiting_) return;
    out_ = std::exchange(next_, {});
    waiting_ = false;
    writing_ = true;
    written_at_ = Clock::now();
    StartWrite(&out_);
  }

  LayoutService* const service_;
  grpc::CallbackServerContext* const context_;
  const bool auras_;
  v1::LayoutUpdate out_, next_;
  Clock::time_point written_at_;
  grpc::Status verdict_;
  bool waiting_ = false, writing_ = false, ended_ = false;
};

grpc::ServerWriteReactor<v1::LayoutUpdate>* LayoutService::Watch(grpc::CallbackServerContext* context,
                                                                 const v1::WatchLayoutRequest& request) {
  auto* stream = new Stream(this, context, request.auras());
  const std::lock_guard lock(mutex_);
  streams_.insert(stream);
  want_auras_ += request.auras() ? 1 : 0;
  if (!serving_) {
    stream->End(NoRegion());
  } else if (streams_.size() > kMostStreams) {
    stream->End(Refusal(grpc::StatusCode::RESOURCE_EXHAUSTED, v1::BUSY, "",
                        absl::StrCat("the server tells its status to at most ", kMostStreams, " clients; try later")));
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

void LayoutService::Stop() {
  const std::lock_guard lock(mutex_);
  serving_ = false;
  for (Stream* s : streams_) s->End(RegionGivenUp());
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
