#include "client/src/layout_follower.h"

#include <algorithm>
#include <chrono>
#include <utility>

#include <grpcpp/support/channel_arguments.h>

#include "client/src/channel.h"

namespace aureole::client {
namespace {

constexpr std::chrono::milliseconds kMinBackoff(50), kMaxBackoff(1000);
// Nothing comes while nothing changes, so a machine that has gone silent is found by pings.
constexpr int kPingMs = 10'000, kPingTimeoutMs = 5'000;

std::shared_ptr<grpc::Channel> Connect(const std::string& endpoint, const Access& access) {
  grpc::ChannelArguments arguments;
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, kPingMs);
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, kPingTimeoutMs);
  arguments.SetInt(GRPC_ARG_HTTP2_MAX_PINGS_WITHOUT_DATA, 0);
  return ChannelTo(endpoint, access, std::move(arguments));
}

bool SamePlaces(const v1::GetWorldResponse& a, const v1::GetWorldResponse& b) {
  return std::equal(a.endpoints().begin(), a.endpoints().end(), b.endpoints().begin(), b.endpoints().end());
}

// Whether the server that tells this layout is in it no more.
bool HasLeft(const v1::GetWorldResponse& world) {
  return world.region() < world.endpoints_size() && world.endpoints(world.region()).empty();
}

}  // namespace

std::vector<std::string> EndpointsOf(const v1::GetWorldResponse& world) {
  std::vector<std::string> out;
  std::copy_if(world.endpoints().begin(), world.endpoints().end(), std::back_inserter(out),
               [](const std::string& endpoint) { return !endpoint.empty(); });
  return out;
}

LayoutFollower::LayoutFollower(std::string server, v1::GetWorldResponse first, Access access, Changed changed)
    : server_(std::move(server)),
      access_(std::move(access)),
      changed_(std::move(changed)),
      world_(std::move(first)),
      thread_([this] { Run(); }) {}

LayoutFollower::~LayoutFollower() {
  {
    const std::lock_guard lock(mutex_);
    ended_ = true;
    if (context_ != nullptr) context_->TryCancel();
  }
  ended_changed_.notify_all();
  thread_.join();
}

void LayoutFollower::Run() {
  std::chrono::milliseconds backoff = kMinBackoff;
  for (size_t turn = 0;; ++turn) {
    std::vector<std::string> known = EndpointsOf(world_);
    known.insert(turn == 0 ? known.begin() : known.end(), server_);
    std::shared_ptr<grpc::ClientContext> context;
    {
      const std::lock_guard lock(mutex_);
      if (ended_) return;
      context = context_ = std::make_shared<grpc::ClientContext>();
    }
    backoff = Listen(known[turn % known.size()], context.get()) ? kMinBackoff : std::min(2 * backoff, kMaxBackoff);
    std::unique_lock lock(mutex_);
    context_ = nullptr;
    ended_changed_.wait_for(lock, backoff, [this] { return ended_; });
  }
}

// False when it has told nothing.
bool LayoutFollower::Listen(const std::string& endpoint, grpc::ClientContext* context) {
  const auto stub = v1::Simulation::NewStub(Connect(endpoint, access_));
  v1::WatchLayoutRequest request;
  request.set_layout_only(true);
  const auto stream = stub->WatchLayout(context, request);
  v1::LayoutUpdate update;
  bool told = false;
  while (stream->Read(&update)) {
    if (!update.has_world()) continue;
    if (update.world().name() != world_.name()) break;  // another world has taken its address
    told = true;
    Take(update.world());
    if (HasLeft(update.world())) break;
  }
  context->TryCancel();
  stream->Finish();
  return told;
}

// One that has come back tells an older layout until it has caught up.
void LayoutFollower::Take(const v1::GetWorldResponse& world) {
  const bool newer = world.layout_epoch() > world_.layout_epoch() ||
                     (world.layout_epoch() == world_.layout_epoch() && !SamePlaces(world, world_));
  if (!newer) return;
  world_ = world;
  changed_(world_);
}

}  // namespace aureole::client
