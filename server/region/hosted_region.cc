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

absl::StatusOr<std::unique_ptr<HostedRegion>> HostedRegion::Load(const v1::Assignment& assignment,
                                                                 const std::filesystem::path& data) {
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
  if (assignment.checkpoint_every() < 0) {
    return absl::InvalidArgumentError("assignment.checkpoint_every: must not be negative");
  }
  if (assignment.incarnations_size() != 0 && assignment.incarnations_size() != regions) {
    return absl::InvalidArgumentError("assignment.incarnations: must be empty, or have one for each region");
  }
  if (assignment.checkpoint_every() > 0 && data.empty()) {
    return absl::InvalidArgumentError(
        "assignment.checkpoint_every: this server has no directory for checkpoints; start it with --data");
  }
  if (assignment.recover() && assignment.checkpoint_every() == 0) {
    return absl::InvalidArgumentError("assignment.recover: needs checkpoints; set assignment.checkpoint_every");
  }
  std::unique_ptr<HostedRegion> out(new HostedRegion(assignment, *std::move(world)));
  if (absl::Status s = out->LoadRegion(data); !s.ok()) return s;
  return out;
}

HostedRegion::HostedRegion(const v1::Assignment& assignment, World world)
    : assignment_(assignment), world_(std::move(world)) {}

absl::Status HostedRegion::LoadRegion(const std::filesystem::path& data) {
  const bool keep = assignment_.checkpoint_every() > 0;
  if (keep) {
    absl::StatusOr<std::unique_ptr<Journal>> journal = Journal::Open(data, assignment_.incarnation());
    if (!journal.ok()) return journal.status();
    journal_ = *std::move(journal);
  }
  std::map<RegionId, LinkState> states;
  if (assignment_.recover()) {
    absl::StatusOr<Journal::Recovered> found = journal_->Recover(WorldHash(assignment_.world()), assignment_.region());
    if (!found.ok()) return found.status();
    absl::StatusOr<std::unique_ptr<Region>> region =
        Region::Load(world_, assignment_.region(), MakeBulletEngine(world_.environment), found->checkpoint.state);
    if (!region.ok()) return region.status();
    region_ = *std::move(region);
    states = std::move(found->checkpoint.links);
    replay_ = std::move(found->inputs);
    hashes_ = std::move(found->checkpoint.hashes);
  } else {
    region_ = std::make_unique<Region>(world_, assignment_.region(), MakeBulletEngine(world_.environment));
  }
  const auto log = [](RegionId peer, const std::string& what) { spdlog::info("link to region {}: {}", peer, what); };
  LinkIdentity identity = IdentityOf(assignment_, world_);
  if (!replay_.empty()) identity.log_until = replay_.back().tick;
  links_ = std::make_unique<RegionLinks>(identity, region_->peers(), log, keep, std::move(states));
  for (RegionId peer : region_->peers()) {
    if (peer < assignment_.incarnations_size()) links_->Redirect(peer, "", assignment_.incarnations(peer));
  }
  if (!keep || assignment_.recover()) return absl::OkStatus();
  return journal_->Begin(TakeCheckpoint(WorldHash(assignment_.world()), *region_, *links_));
}

void HostedRegion::PeerMoved(const v1::PeerMoved& moved) {
  links_->Redirect(moved.region(), moved.endpoint(), moved.incarnation());
}

HostedRegion::~HostedRegion() { Stop(); }

void HostedRegion::Connect(PeerService* service, const std::shared_ptr<grpc::ChannelCredentials>& credentials) {
  links_->Connect(service, {assignment_.endpoints().begin(), assignment_.endpoints().end()}, credentials);
}

void HostedRegion::Start(int64_t start_unix_us, TickLoop::Hooks hooks) {
  TickLoop::Options options;
  options.real_time = !assignment_.no_real_time();
  options.start_unix_us = start_unix_us;
  options.last_tick = assignment_.last_tick();
  options.hash_every = assignment_.hash_every();
  options.checkpoint_every = assignment_.checkpoint_every();
  options.world_hash = WorldHash(assignment_.world());
  options.recovered = assignment_.recover();
  options.replay = std::move(replay_);
  options.hashes = std::move(hashes_);
  loop_ = std::make_unique<TickLoop>(world_, region_.get(), links_.get(), journal_.get(), std::move(options),
                                     std::move(hooks));
  thread_ = std::thread([this] { loop_->Run(); });
}

HostedRegion::Progress HostedRegion::progress() const {
  if (loop_ == nullptr) return {region_->tick(), region_->bodies()};
  return {loop_->reported_tick(), loop_->reported_bodies()};
}

void HostedRegion::SayAgain() {
  if (loop_ != nullptr) loop_->SayAgain();
}

void HostedRegion::Stop() {
  if (!thread_.joinable()) return;
  loop_->Stop();
  thread_.join();
}

}  // namespace aureole
