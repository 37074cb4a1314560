#include "client/cli/layout_watch.h"

#include <chrono>
#include <utility>

#include "client/cli/connect.h"
#include "client/src/channel.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;

}  // namespace

std::unique_ptr<LayoutWatch> LayoutWatch::Open(const std::string& server, std::string* error) {
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(10));
  v1::GetWorldResponse world;
  const auto stub = v1::Simulation::NewStub(client::ChannelTo(server, GivenAccess()));
  if (const grpc::Status s = stub->GetWorld(&context, {}, &world); !s.ok()) {
    *error = s.error_message();
    return nullptr;
  }
  return std::unique_ptr<LayoutWatch>(new LayoutWatch(std::move(world)));
}

LayoutWatch::LayoutWatch(v1::GetWorldResponse world) : world_(std::move(world)) {
  status_.stage = Stage::kRunning;
  status_.regions.resize(static_cast<size_t>(world_.endpoints_size()));
  for (size_t r = 0; r < status_.regions.size(); ++r) {
    RegionStatus& region = status_.regions[r];
    region.joined = region.ready = true;
    region.endpoint = world_.endpoints(static_cast<int>(r));
    region.reported = Clock::now();
    contexts_.push_back(std::make_unique<grpc::ClientContext>());
  }
  for (size_t r = 0; r < status_.regions.size(); ++r) threads_.emplace_back([this, r] { Listen(r); });
}

LayoutWatch::~LayoutWatch() {
  for (const auto& c : contexts_) c->TryCancel();
  for (std::thread& t : threads_) t.join();
}

RunStatus LayoutWatch::status() const {
  const std::lock_guard lock(mutex_);
  return status_;
}

void LayoutWatch::Listen(size_t region) {
  const auto stub =
      v1::Simulation::NewStub(client::ChannelTo(world_.endpoints(static_cast<int>(region)), GivenAccess()));
  const auto stream = stub->WatchLayout(contexts_[region].get(), {});
  v1::LayoutUpdate update;
  while (stream->Read(&update)) {
    if (update.has_status()) Take(region, update.status());
  }
  const grpc::Status s = stream->Finish();
  const std::lock_guard lock(mutex_);
  status_.regions[region].left = true;
  status_.regions[region].goodbye = s.error_message();
}

void LayoutWatch::Take(size_t region, const v1::RegionStatus& s) {
  const std::lock_guard lock(mutex_);
  RegionStatus& r = status_.regions[region];
  const Clock::time_point now = Clock::now();
  const double seconds = std::chrono::duration<double>(now - r.reported).count();
  if (r.report.tick() > 0 && seconds > 0) {
    r.bytes_per_second = static_cast<double>(s.bytes_sent() - r.report.bytes_sent()) / seconds;
  }
  r.reported = now;
  r.frame.set_mean_ms(s.frame_mean_ms());
  r.frame.set_p99_ms(s.frame_p99_ms());
  r.frame.set_max_ms(s.frame_max_ms());
  v1::Report& report = r.report;
  report.set_tick(s.tick());
  report.set_bodies(s.bodies());
  report.set_awake(s.awake());
  report.set_real_time_factor(s.real_time_factor());
  report.set_auras_told(s.auras());
  report.set_transfers(s.transfers());
  report.set_bodies_moved(s.bodies_moved());
  report.set_bytes_sent(s.bytes_sent());
  report.set_waits(s.waits());
  report.set_wait_us(s.wait_us());
  report.set_violations(s.violations());
  *report.mutable_waiting_for() = s.waiting_for();
}

}  // namespace aureole
