#include "server/region/hosted_region.h"

#include <limits>
#include <utility>

#include <absl/strings/str_cat.h>
#include <spdlog/spdlog.h>

#include "server/physics/bullet_engine.h"
#include "server/transport/link_limits.h"
#include "server/transport/world_spec.h"

namespace aureole {
namespace {

LinkIdentity IdentityOf(const v1::Assignment& assignment, const World& world) {
  LinkIdentity identity;
  identity.protocol_version = kPeerProtocolVersion;
  identity.world_hash = WorldHash(assignment.world());
  identity.layout_epoch = assignment.layout_epoch();
  identity.self = assignment.region();
  identity.incarnation = assignment.incarnation();
  identity.exchange_delay = world.exchange.k;
  identity.tick_us = world.environment.tick_us;
  return identity;
}

}  // namespace

absl::StatusOr<std::unique_ptr<HostedRegion>> HostedRegion::Load(const v1::Assignment& assignment) {
  absl::StatusOr<World> world = WorldFromSpec(assignment.world());
  if (!world.ok()) return world.status();
  if (assignment.undivided()) {
    // The same world but for its layout.
    absl::StatusOr<Layout> one = Layout::Columns({});
    if (!one.ok()) return one.status();
    world->layout = *std::move(one);
  }
  const int regions = world->layout.size();
  if (assignment.region() < 0 || assignment.region() >= regions) {
    return absl::InvalidArgumentError(
        absl::StrCat("assignment.region: is ", assignment.region(), ", the world has ", regions, " regions"));
  }
  if (assignment.endpoints_size() != regions) {
    return absl::InvalidArgumentError(absl::StrCat("assignment.endpoints: has ", assignment.endpoints_size(),
                                                   " entries, the world has ", regions, " regions"));
  }
  if (assignment.incarnation() == 0) {
    return absl::InvalidArgumentError("assignment.incarnation: must be at least 1");
  }
  return std::unique_ptr<HostedRegion>(new HostedRegion(assignment, *std::move(world)));
}

HostedRegion::HostedRegion(const v1::Assignment& assignment, World world)
    : assignment_(assignment),
      world_(std::move(world)),
      region_(std::make_unique<Region>(world_, assignment.region(), MakeBulletEngine(world_.environment))),
      links_(std::make_unique<RegionLinks>(
          IdentityOf(assignment_, world_), region_->peers(),
          [](RegionId peer, const std::string& what) { spdlog::info("link to region {}: {}", peer, what); })) {}

HostedRegion::~HostedRegion() { Stop(); }

void HostedRegion::Connect(PeerService* service) {
  links_->Connect(service, {assignment_.endpoints().begin(), assignment_.endpoints().end()});
}

void HostedRegion::Start(int64_t start_unix_us, TickLoop::Hooks hooks) {
  TickLoop::Options options;
  options.real_time = !assignment_.no_real_time();
  options.start_unix_us = start_unix_us;
  options.last_tick = assignment_.last_tick();
  options.hash_every = assignment_.hash_every();
  loop_ = std::make_unique<TickLoop>(world_, region_.get(), links_.get(), options, std::move(hooks));
  thread_ = std::thread([this] { loop_->Run(); });
}

void HostedRegion::Stop() {
  if (!thread_.joinable()) return;
  loop_->Stop();
  thread_.join();
}

}  // namespace aureole
