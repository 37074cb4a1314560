#include "client/cli/layout_watch.h"

#include <algorithm>
#include <chrono>
#include <iterator>
#include <utility>

#include "client/cli/connect.h"
#include "client/src/channel.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::chrono::milliseconds kListenAgain(500);

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
  return std::unique_ptr<LayoutWatch>(new LayoutWatch(server, world));
}

LayoutWatch::LayoutWatch(const std::string& server, const v1::GetWorldResponse& world) {
  status_.stage = Stage::kRunning;
  Follow(world);
  follower_ = std::make_unique<client::LayoutFollower>(server, world, GivenAccess(),
                                                       [this](const v1::GetWorldResponse& now) { Follow(now); });
}

LayoutWatch::~LayoutWatch() {
  follower_.reset();
  for (auto& [region, listener] : listeners_) End(std::move(listener));
}

v1::GetWorldResponse LayoutWatch::world() const {
  const std::lock_guard lock(mutex_);
  return world_;
}

RunStatus LayoutWatch::status() const {
  const std::lock_guard lock(mutex_);
  return status_;
}

// A listener for each region that is there, at its endpoint.
void LayoutWatch::Follow(const v1::GetWorldResponse& world) {
  const auto endpoint_of = [&](size_t region) { return world.endpoints(static_cast<int>(region)); };
  const auto regions = static_cast<size_t>(world.endpoints_size());
  for (auto it = listeners_.begin(); it != listeners_.end();) {
    const bool stays = it->first < regions && endpoint_of(it->first) == it->second->endpoint;
    if (!stays) End(std::move(it->second));
    it = stays ? std::next(it) : listeners_.erase(it);
  }
  const std::lock_guard lock(mutex_);
  world_ = world;
  status_.regions.resize(std::max(status_.regions.size(), regions));
  for (size_t r = 0; r < status_.regions.size(); ++r) {
    RegionStatus& region = status_.regions[r];
    const std::string endpoint = r < regions ? endpoint_of(r) : "";
    if (endpoint.empty() || listeners_.contains(r)) {
      if (endpoint.empty()) region = {};
      region.member = !endpoint.empty();
      region.left |= endpoint.empty();
      continue;
    }
    region = {};
    region.joined = region.ready = true;
    region.endpoint = endpoint;
    region.reported = Clock::now();
    Listener& listener = *(listeners_[r] = std::make_unique<Listener>());
    listener.endpoint = endpoint;
    listener.thread = std::thread([this, r, &listener] { Listen(r, &listener); });
  }
}

void LayoutWatch::Listen(size_t region, Listener* listener) {
  const auto stub = v1::Simulation::NewStub(client::ChannelTo(listener->endpoint, GivenAccess()));
  std::unique_lock lock(mutex_);
  while (!listener->ended) {
    const auto context = listener->context = std::make_shared<grpc::ClientContext>();
    lock.unlock();
    const auto stream = stub->WatchLayout(context.get(), {});
    v1::LayoutUpdate update;
    while (stream->Read(&update)) {
      if (update.has_status()) Take(region, update.status());
    }
    const grpc::Status s = stream->Finish();
    lock.lock();
    if (listener->ended) break;
    status_.regions[region].left = true;
    status_.regions[region].goodbye = s.error_message();
    ended_changed_.wait_for(lock, kListenAgain, [&] { return listener->ended; });
  }
}

void LayoutWatch::End(std::unique_ptr<Listener> listener) {
  {
    const std::lock_guard lock(mutex_);
    listener->ended = true;
    if (listener->context != nullptr) listener->context->TryCancel();
  }
  ended_changed_.notify_all();
  listener->thread.join();
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
  r.left = false;
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
