#include "server/region/hosted_region.h"

#include <limits>
#include <utility>

#include <absl/strings/str_cat.h>
#include <spdlog/spdlog.h>

#include "server/physics/bullet_engine.h"
#include "server/region/copy_fetch.h"
#include "server/transport/input_codec.h"
#include "server/transport/link_limits.h"
#include "server/transport/world_spec.h"

namespace aureole {
namespace {

LinkIdentity IdentityOf(const v1::Assignment& assignment, const World& world) {
  LinkIdentity identity;
  identity.protocol_version = kPeerProtocolVersion;
  identity.world_hash = WorldHash(assignment.world());
  identity.layout_epoch = assignment.has_join() ? assignment.join().epoch() : kFirstLayoutEpoch;
  identity.self = assignment.region();
  identity.incarnation = assignment.incarnation();
  identity.exchange_delay = world.exchange.k;
  identity.tick_us = world.environment.tick_us;
  return identity;
}

}  // namespace

absl::StatusOr<std::unique_ptr<HostedRegion>> HostedRegion::Load(
    const v1::Assignment& assignment, const std::filesystem::path& data,
    const std::shared_ptr<grpc::ChannelCredentials>& credentials) {
  absl::StatusOr<World> world = WorldFromSpec(assignment.world());
  if (!world.ok()) return world.status();
  if (assignment.undivided()) {
    // The same world but for its layout.
    absl::StatusOr<Layout> one = Layout::Columns({});
    if (!one.ok()) return one.status();
    world->layout = *std::move(one);
  }
  // The list only grows with the layouts of a world.
  const int first_regions = world->layout.size(), regions = assignment.endpoints_size();
  if (regions < first_regions || regions > limits::kMaxRegions) {
    return absl::InvalidArgumentError(
        absl::StrCat("assignment.endpoints: has ", regions, " entries, the world has ", first_regions, " regions"));
  }
  if (assignment.region() < 0 || assignment.region() >= regions) {
    return absl::InvalidArgumentError(
        absl::StrCat("assignment.region: is ", assignment.region(), ", the world has ", regions, " regions"));
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
  if (absl::Status s = out->LoadRegion(data, credentials); !s.ok()) return s;
  return out;
}

HostedRegion::HostedRegion(const v1::Assignment& assignment, World world)
    : assignment_(assignment), world_(std::move(world)) {}

// From its own volume, or else from the keeper.
absl::StatusOr<Journal::Recovered> HostedRegion::Find(const Credentials& credentials) {
  const CopyIdentity identity{WorldHash(assignment_.world()), assignment_.region(), assignment_.incarnation()};
  absl::StatusOr<Journal::Recovered> own = journal_->Recover(
      identity.world_hash, identity.region, {assignment_.ready_incarnation(), assignment_.volume_from()});
  if (own.ok() || absl::IsAborted(own.status())) return own;
  const RegionId keeper = assignment_.keeper() - 1;
  const std::string why(own.status().message());
  if (keeper < 0 || keeper >= assignment_.endpoints_size()) {
    return absl::Status(own.status().code(), absl::StrCat(why, "; and there is no copy yet"));
  }
  spdlog::warn("no checkpoint here: {}; asks region {} for its copy", why, keeper);
  absl::StatusOr<Journal::Recovered> copy =
      FetchCopy(identity, keeper, assignment_.endpoints(keeper), credentials, kLongestFetch);
  if (copy.ok() && copy->checkpoint.tick < assignment_.copy_from()) {
    copy = absl::FailedPreconditionError(absl::StrCat("it is of tick ", copy->checkpoint.tick,
                                                      ", and what it lacks is as late as ", assignment_.copy_from(),
                                                      ": the region was not protected by a copy"));
  }
  absl::Status s = copy.status();
  if (s.ok()) s = journal_->Adopt(*copy);
  if (!s.ok()) {
    return absl::DataLossError(absl::StrCat("no checkpoint to go on from: ", why, "; and no copy at region ", keeper,
                                            ": ", std::string(s.message())));
  }
  fetched_ = absl::StrCat("the copy at region ", keeper, ", of tick ", copy->checkpoint.tick, ", because ", why);
  return copy;
}

absl::Status HostedRegion::LoadRegion(const std::filesystem::path& data, const Credentials& credentials) {
  const bool keep = assignment_.checkpoint_every() > 0;
  if (keep) {
    absl::StatusOr<std::unique_ptr<Journal>> journal = Journal::Open(data, assignment_.incarnation());
    if (!journal.ok()) return journal.status();
    journal_ = *std::move(journal);
  }
  absl::Status s = assignment_.recover() ? Recover(credentials) : absl::NotFoundError("a first life");
  const bool joins = assignment_.has_join() && absl::IsNotFound(s);
  if (!assignment_.recover() || joins) s = MakeRegion();
  if (!s.ok()) return s;
  if (keep) {
    // What is at the keeper may have inputs that the own log has not, or lack some that it has, which were told to
    // nobody before, and are now.
    const Tick least = !recovered_ ? 0 : fetched_.empty() ? region_->tick() + 1 : region_->tick();
    copy_ = std::make_unique<CopySender>(
        CopyIdentity{WorldHash(assignment_.world()), assignment_.region(), assignment_.incarnation()}, least,
        [](const std::string& what) { spdlog::info("{}", what); });
    journal_->CopyTo(copy_.get());
  }
  const auto log = [](RegionId peer, const std::string& what) { spdlog::info("link to region {}: {}", peer, what); };
  LinkIdentity identity = IdentityOf(assignment_, world_);
  if (!replay_.empty()) identity.log_until = replay_.back().tick;
  links_ = std::make_unique<RegionLinks>(identity, region_->peers(), log, keep, std::move(link_states_));
  for (RegionId peer = 0; peer < assignment_.incarnations_size(); ++peer) {
    links_->Redirect(peer, "", assignment_.incarnations(peer));
    if (assignment_.incarnations(peer) == 0) links_->Forget(peer);
  }
  if (!keep || recovered_) return absl::OkStatus();
  // What is here may be of another region that had this name. One that joins begins its journal when it has.
  if (joins) return journal_->Clear();
  return journal_->Begin(TakeCheckpoint(WorldHash(assignment_.world()), *region_, *links_));
}

absl::Status HostedRegion::Recover(const Credentials& credentials) {
  absl::StatusOr<Journal::Recovered> found = Find(credentials);
  if (!found.ok()) return found.status();
  absl::StatusOr<std::unique_ptr<Region>> region =
      Region::Load(world_, assignment_.region(), MakeBulletEngine(world_.environment), found->checkpoint.state);
  if (!region.ok()) return region.status();
  region_ = *std::move(region);
  link_states_ = std::move(found->checkpoint.links);
  replay_ = std::move(found->inputs);
  hashes_ = std::move(found->checkpoint.hashes);
  recovered_ = true;
  return absl::OkStatus();
}

absl::Status HostedRegion::MakeRegion() {
  std::unique_ptr<Engine> engine = MakeBulletEngine(world_.environment);
  if (!assignment_.has_join()) {
    if (assignment_.region() >= world_.layout.size()) {
      return absl::InvalidArgumentError(absl::StrCat("assignment.region: is ", assignment_.region(),
                                                     ", which the world does not begin with; set assignment.join"));
    }
    region_ = std::make_unique<Region>(world_, assignment_.region(), std::move(engine));
    return absl::OkStatus();
  }
  LayoutChange change;
  absl::Status s = DecodeLayoutChange(assignment_.join(), &change);
  if (s.ok()) {
    absl::StatusOr<std::unique_ptr<Region>> region =
        Region::Join(world_, assignment_.region(), std::move(engine), change);
    s = region.status();
    if (s.ok()) region_ = *std::move(region);
  }
  return s.ok() ? s : absl::Status(s.code(), absl::StrCat("assignment.join.", s.message()));
}

void HostedRegion::PeerMoved(const v1::PeerMoved& moved) {
  links_->Redirect(moved.region(), moved.endpoint(), moved.incarnation());
  if (copy_ != nullptr) copy_->Redirect(moved.region(), moved.endpoint(), moved.incarnation());
  if (moved.joins() != 0) links_->Expect(moved.region(), moved.joins());
}

void HostedRegion::PeerLeft(const v1::PeerLeft& left) { links_->Forget(left.region()); }

absl::Status HostedRegion::ChangeLayout(const v1::ChangeLayout& change) {
  if (loop_ == nullptr) return absl::FailedPreconditionError("change_layout: before the Start");
  auto layout = std::make_shared<aureole::LayoutChange>();
  if (absl::Status s = DecodeLayoutChange(change.layout(), layout.get()); !s.ok()) return s;
  Input input;
  input.source = kControlSource;
  input.sequence = change.sequence();
  input.kind = Input::Kind::kLayout;
  input.layout = std::move(layout);
  if (absl::Status s = CheckLiveInput(input); !s.ok()) return s;
  loop_->Offer(input);
  return absl::OkStatus();
}

void HostedRegion::SaveAt(Tick n) {
  if (loop_ != nullptr) loop_->SaveAt(n);
}

HostedRegion::~HostedRegion() { Stop(); }

void HostedRegion::Connect(PeerService* service, const std::shared_ptr<grpc::ChannelCredentials>& credentials) {
  const std::vector<std::string> endpoints(assignment_.endpoints().begin(), assignment_.endpoints().end());
  links_->Connect(service, endpoints, credentials);
  if (copy_ != nullptr) {
    copy_->Connect(KeeperOf(assignment_.region(), region_->members()), endpoints, credentials);
  }
}

void HostedRegion::Start(int64_t start_unix_us, TickLoop::Hooks hooks) {
  TickLoop::Options options;
  options.real_time = !assignment_.no_real_time();
  options.start_unix_us = start_unix_us;
  options.last_tick = assignment_.last_tick();
  options.hash_every = assignment_.hash_every();
  options.checkpoint_every = assignment_.checkpoint_every();
  options.world_hash = WorldHash(assignment_.world());
  options.recovered = recovered_;
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
