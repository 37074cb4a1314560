#include "server/region/tick_loop.h"

#include <algorithm>
#include <ctime>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_join.h>

namespace aureole {
namespace {

using std::chrono::microseconds;
using std::chrono::milliseconds;

constexpr milliseconds kReportEvery(200);
constexpr milliseconds kWaitIsWorthTelling(100);  // in reports
constexpr milliseconds kWaitIsWorthLogging(1000);
constexpr milliseconds kLookEvery(20);      // whether a region that has left may go
constexpr milliseconds kLongestSleep(100);  // so that Stop is heard
// A world that is later than this, because a server was overloaded or dead, does not try to make it up: nobody wants to
// watch the lost time run past.
constexpr milliseconds kMostBehind(500);
// More than are made while a control plane is replaced, and between two reports.
constexpr size_t kRecentHashes = 4096, kCheckpointHashes = 256;
constexpr int kMostUnsaid = 1024;

double Ms(std::chrono::steady_clock::duration d) { return std::chrono::duration<double, std::milli>(d).count(); }

void SleepUntil(std::chrono::steady_clock::time_point t) {
  const auto ns = std::chrono::duration_cast<std::chrono::nanoseconds>(t.time_since_epoch()).count();
  const timespec when{static_cast<time_t>(ns / 1'000'000'000), static_cast<long>(ns % 1'000'000'000)};
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &when, nullptr) == EINTR) {
  }
}

}  // namespace

TickLoop::TickLoop(const World& world, Region* region, RegionLinks* links, Journal* journal, Options options,
                   Hooks hooks)
    : world_(world),
      region_(region),
      links_(links),
      journal_(journal),
      options_(std::move(options)),
      hooks_(std::move(hooks)),
      said_tick_(region->tick()),
      said_bodies_(region->bodies()),
      windows_(world.environment.tick_us),
      replaying_(options_.recovered),
      checkpointed_(region->tick()) {
  for (const aureole::Checkpoint::Hash& h : options_.hashes) AddHash(h);
}

void TickLoop::SaveAt(Tick n) {
  const std::lock_guard lock(offers_mutex_);
  save_at_.insert(n);
}

void TickLoop::Stop() {
  stopped_ = true;
  links_->Interrupt();
}

bool TickLoop::Run() {
  const microseconds until_start(
      options_.start_unix_us -
      std::chrono::duration_cast<microseconds>(std::chrono::system_clock::now().time_since_epoch()).count());
  start_ = Clock::now() + until_start;
  reported_at_ = Clock::now();
  reported_tick_ = region_->tick();
  FollowLayout();
  const auto done = [this] { return options_.last_tick > 0 && region_->tick() >= options_.last_tick; };
  const auto left = [this] { return region_->phase() == Phase::kLeft; };
  if (!Join()) return false;
  while (!done() && !left() && SleepUntilDue(region_->tick() + 1)) {
    EndLap();
    if (!RunTick()) break;
    AfterTick();
    if (Clock::now() - reported_at_ >= kReportEvery || pending_.windows_size() > 0) Report({}, false);
    if (journal_ != nullptr) {  // when nobody waits for this region's frames
      TellDurable();
      Checkpoint(IsAskedToSave() ? 0 : options_.checkpoint_every);
    }
  }
  EndLap();
  if (left() && !done()) Leave();
  Report({}, done());
  return done();
}

void TickLoop::Offer(const Input& change) {
  const std::lock_guard lock(offers_mutex_);
  offers_.push_back(change);
}

// Until the welcome has come; false when stopped. Reports say whom the region has not met yet: before it has met all,
// the world should not hear of the change with which it joins.
bool TickLoop::Join() {
  if (region_->phase() != Phase::kJoin) return true;
  while (!region_->Ready() && !stopped_) {
    Take(Clock::now() + kReportEvery / 2);
    if (Clock::now() - reported_at_ < kReportEvery) continue;
    missing_.clear();
    links_->Unmet(&missing_);
    pending_.set_may_join(missing_.empty());
    Report(missing_, false);
  }
  if (stopped_) return false;
  region_->Advance(&out_);
  checkpointed_ = reported_tick_ = region_->tick();
  if (journal_ != nullptr) {
    // Before anybody hears of it, so the next incarnation joins again, or goes on from here.
    const absl::Status s = journal_->Begin(TakeCheckpoint(options_.world_hash, *region_, *links_));
    if (absl::IsAborted(s)) {
      hooks_.fenced();
      return false;
    }
    if (!s.ok()) hooks_.log(absl::StrCat("the first checkpoint: ", std::string(s.message())));
  }
  FollowLayout();
  hooks_.log(absl::StrCat("joined after tick ", region_->tick()));
  return true;
}

// What the others may need stays until they do not: their last word is durable here, and this region's there.
void TickLoop::Leave() {
  hooks_.log(absl::StrCat("left after tick ", region_->tick()));
  links_->Part();
  while (!stopped_) {
    const bool durable = journal_ == nullptr || journal_->durable(region_->tick());
    if (journal_ != nullptr) TellDurable();
    if (journal_ != nullptr && journal_->fenced()) return hooks_.fenced();
    if (durable && links_->released()) return hooks_.gone();
    if (!durable) Checkpoint(0);
    Take(Clock::now() + kLookEvery);
    if (Clock::now() - reported_at_ >= kReportEvery) Report({}, false);
  }
}

// Links to those that come and from those that go.
void TickLoop::FollowLayout() {
  if (region_->layout_epoch() == followed_epoch_ && region_->next_layout_at() == followed_next_) return;
  followed_epoch_ = region_->layout_epoch();
  followed_next_ = region_->next_layout_at();
  links_->Follow(followed_epoch_, region_->members(), region_->next_members());
}

bool TickLoop::SleepUntilDue(Tick n) {
  if (replaying_ && links_->caught_up()) EndReplay();
  if (!options_.real_time || replaying_) return !stopped_;
  const Clock::time_point since = Clock::now();
  Clock::time_point due = start_ + microseconds(n * world_.environment.tick_us);
  if (since - due > kMostBehind) {
    start_ += since - due;
    lost_ += since - due;
    due = since;
  }
  while (!stopped_ && Clock::now() < due) SleepUntil(std::min<Clock::time_point>(due, Clock::now() + kLongestSleep));
  clock_.AddWait(Ms(Clock::now() - since));
  return !stopped_;
}

bool TickLoop::RunTick() {
  const Tick n = region_->tick() + 1;
  OfferInputs();
  // An input that this one has logged in vain the later one may have found, and will tell in this tick.
  if (journal_ != nullptr && journal_->fenced()) {
    hooks_.fenced();
    return false;
  }
  while (region_->tick() < n) {
    if (!AwaitPeers()) return false;
    out_.clear();
    region_->Advance(&out_);
    links_->Send(out_);
  }
  lap_of_ = n;
  FollowLayout();
  return true;
}

// Nothing that this incarnation says may differ from what an earlier one has said, so new inputs wait until that is
// over. Without a journal inputs act at once; with one they are made durable during a tick and offered in the next.
void TickLoop::OfferInputs() {
  const Tick n = region_->tick() + 1;
  for (; replayed_ < options_.replay.size() && options_.replay[replayed_].tick <= n; ++replayed_) {
    Submit(options_.replay[replayed_].input);
  }
  if (!logged_.empty()) {
    if (absl::Status s = journal_->AwaitLogged(); !s.ok()) {
      hooks_.log(absl::StrCat("inputs of tick ", n, " are not durable: ", std::string(s.message())));
    }
    // Heard before it is told: until there is a copy again, the one that may be there does not have it.
    if (journal_->stats().copy.alone && !alone_said_) Report({}, false);
    for (const Input& input : logged_) Submit(input);
    logged_.clear();
  }
  // When all servers died, none knows how far the world had come, and a client's newer inputs must not overtake those
  // that another region's log still holds for later ticks.
  if (replaying_ || n <= log_until_ || region_->inputs_waiting() > 0) return;
  std::vector<Input> inputs = hooks_.inputs();
  {
    const std::lock_guard lock(offers_mutex_);
    inputs.insert(inputs.end(), offers_.begin(), offers_.end());
    offers_.clear();
  }
  if (journal_ == nullptr) {
    for (const Input& input : inputs) Submit(input);
  } else if (!inputs.empty()) {
    journal_->Log(n + 1, inputs);
    logged_ = std::move(inputs);
  }
}

void TickLoop::Submit(const Input& input) {
  if (absl::Status s = region_->Submit(input); !s.ok()) {
    hooks_.log(
        absl::StrCat("input ", input.sequence, " of client ", input.source, " refused: ", std::string(s.message())));
  }
}

void TickLoop::TellDurable() {
  if (const std::optional<Journal::Used> used = journal_->TakeDurable()) links_->SetDurable(*used);
}

bool TickLoop::IsAskedToSave() {
  const std::lock_guard lock(offers_mutex_);
  save_at_.erase(save_at_.begin(), save_at_.upper_bound(checkpointed_));
  return !save_at_.empty() && *save_at_.begin() <= region_->tick();
}

// Unless the last one is not yet so many ticks old, or still being written.
void TickLoop::Checkpoint(Tick after) {
  if (region_->tick() < checkpointed_ + after || journal_->writing()) return;
  const Clock::time_point since = Clock::now();
  aureole::Checkpoint checkpoint = TakeCheckpoint(options_.world_hash, *region_, *links_, journal_->TakeRoom());
  const size_t kept = std::min(recent_hashes_.size(), kCheckpointHashes);
  checkpoint.hashes.assign(recent_hashes_.end() - static_cast<std::ptrdiff_t>(kept), recent_hashes_.end());
  journal_->Write(std::move(checkpoint), KeeperOf(region_->self(), region_->members()));
  checkpointed_ = region_->tick();
  longest_pause_ = std::max(longest_pause_, Clock::now() - since);
}

// What was lost is made up; the wall clock goes on from here, whatever it showed before.
void TickLoop::EndReplay() {
  replaying_ = false;
  log_until_ = links_->log_until();
  start_ = Clock::now() - microseconds((region_->tick() + 1) * world_.environment.tick_us);
  hooks_.log(absl::StrCat("caught up at tick ", region_->tick()));
}

void TickLoop::AppendHash(const aureole::Checkpoint::Hash& h) {
  v1::TickHash* hash = pending_.add_hashes();
  hash->set_tick(h.tick);
  hash->set_hash(h.hash);
  hash->set_bodies(h.bodies);
  hash->set_members(h.members);
}

void TickLoop::AppendRecentHashes() {
  pending_.clear_hashes();
  for (const aureole::Checkpoint::Hash& h : recent_hashes_) AppendHash(h);
}

// Until the control plane is there again, which then asks for the hashes (SayAgain): the newest windows and violations.
void TickLoop::KeepUnsaid() {
  v1::Report kept;
  kept.mutable_windows()->Swap(pending_.mutable_windows());
  kept.mutable_violation_log()->Swap(pending_.mutable_violation_log());
  pending_ = std::move(kept);
  const auto trim = [](auto* field) {
    const int extra = field->size() - kMostUnsaid;
    if (extra > 0) field->DeleteSubrange(0, extra);
  };
  trim(pending_.mutable_windows());
  trim(pending_.mutable_violation_log());
}

void TickLoop::AddHash(const aureole::Checkpoint::Hash& h) {
  AppendHash(h);
  recent_hashes_.push_back(h);
  while (recent_hashes_.size() > kRecentHashes) recent_hashes_.pop_front();
}

// Until the region can go on; false when stopped. Reports go out meanwhile, and say for whom it waits.
bool TickLoop::AwaitPeers() {
  if (!region_->Ready()) Take(Clock::time_point::min());
  if (region_->Ready()) return !stopped_;
  ++waits_;
  const Clock::time_point since = Clock::now();
  bool logged = false;
  while (!region_->Ready() && !stopped_) {
    Take(Clock::now() + kWaitIsWorthTelling);
    const Clock::time_point now = Clock::now();
    if (region_->Ready() || now - since < kWaitIsWorthTelling) continue;
    missing_.clear();
    region_->Missing(&missing_);
    if (now - reported_at_ >= kReportEvery) Report(missing_, false);
    if (!logged && now - since >= kWaitIsWorthLogging) {
      logged = true;
      hooks_.log(absl::StrCat("tick ", region_->tick() + 1, " waits for region ", absl::StrJoin(missing_, ", ")));
    }
  }
  const Clock::duration wait = Clock::now() - since;
  if (logged && !stopped_) {
    hooks_.log(
        absl::StrCat("tick ", region_->tick() + 1, " goes on after a wait of ", static_cast<int64_t>(Ms(wait)), " ms"));
  }
  waited_ += wait;
  clock_.AddWait(Ms(wait));
  return !stopped_;
}

void TickLoop::Take(Clock::time_point deadline) {
  missing_.clear();
  region_->Missing(&missing_);
  // Who joins needs one welcome, of whomever; who has left needs nothing.
  const bool ticks = region_->phase() != Phase::kJoin && region_->phase() != Phase::kLeft;
  links_->Receive(ticks ? missing_.size() : 1, deadline, &in_);
  for (Frame& frame : in_) {
    const RegionId from = frame.from;
    const Tick tick = frame.tick;
    if (absl::Status s = region_->Receive(std::move(frame)); !s.ok()) {
      // Decoded, but not one of the protocol's: the peer is broken. Nothing has changed here; the run waits for it.
      ++refused_;
      hooks_.log(absl::StrCat("frame of tick ", tick, " from region ", from, " refused: ", std::string(s.message())));
      links_->Cut(from);
    }
  }
}

void TickLoop::EndLap() {
  const FrameSample sample = clock_.Lap();
  if (lap_of_ == 0) return;
  windows_.Add(sample);
  frames_since_report_.push_back(sample.process_cpu);
  hooks_.after_tick(sample);
  if (windows_.EndsAt(lap_of_) || lap_of_ == options_.last_tick) {
    v1::Window* window = pending_.add_windows();
    *window = windows_.Take(lap_of_);
    const EngineCounts counts = region_->engine().Counts();
    window->set_bodies(counts.bodies);
    window->set_awake(counts.awake);
    window->set_contacts(counts.contacts);
  }
  lap_of_ = 0;
}

void TickLoop::AfterTick() {
  const Tick n = region_->tick();
  const int64_t bodies = region_->bodies();
  body_ticks_ += bodies;
  away_body_ticks_ += region_->stats().away_bodies;
  if ((options_.hash_every > 0 && n % options_.hash_every == 0) || n == options_.last_tick) {
    std::vector<BodyRecord> records;  // those in flight included
    region_->Observe(&records);
    AddHash({n, region_->StateHash(), static_cast<int64_t>(records.size()),
             static_cast<int32_t>(region_->members().size())});
  }
  if (const std::vector<InputOutcome> outcomes = region_->TakeOutcomes(); !outcomes.empty()) {
    hooks_.outcomes(outcomes);
  }
  for (const Violation& v : region_->TakeViolations()) {
    hooks_.log(absl::StrCat("violation at tick ", v.tick, ": body ", v.own, " of this region and body ", v.foreign,
                            " were stepped apart although they touch, ", v.depth, " m deep at ", v.speed, " m/s"));
    v1::Violation* out = pending_.add_violation_log();
    out->set_tick(v.tick);
    out->set_own(v.own);
    out->set_foreign(v.foreign);
    out->set_depth(v.depth);
    out->set_speed(v.speed);
  }
  hooks_.publish(region_, bodies, region_->TakeDelivered());
}

void TickLoop::Report(const std::vector<RegionId>& waiting_for, bool finished) {
  const Clock::time_point now = Clock::now();
  if (say_again_.exchange(false)) AppendRecentHashes();
  v1::Report& r = pending_;
  const RegionStats& stats = region_->stats();
  const EngineCounts counts = region_->engine().Counts();
  const LinkStats links = links_->Totals();
  const double wall_us = 1e3 * Ms(now - reported_at_);
  const auto simulated_us = static_cast<double>((region_->tick() - reported_tick_) * world_.environment.tick_us);
  r.set_tick(region_->tick());
  r.set_bodies(region_->bodies());
  r.set_awake(counts.awake);
  r.set_real_time_factor(wall_us > 0 ? simulated_us / wall_us : 0);
  *r.mutable_frame() = Summarise(&frames_since_report_);
  r.set_auras_told(stats.auras_told);
  r.set_aura_updates(stats.auras_sent);
  r.set_aura_tests(stats.aura_tests);
  r.set_transfers(stats.transfers_out);
  r.set_touching_transfers(stats.touching_out);
  r.set_bodies_moved(stats.bodies_out);
  r.set_returns(stats.returns_out);
  r.set_largest_cluster(stats.largest_cluster);
  r.set_largest_component(stats.largest_component);
  r.set_longest_chain(stats.longest_chain);
  r.set_home_crossings(stats.home_crossings);
  if (std::any_of(stats.slack.begin(), stats.slack.end(), [](int64_t n) { return n > 0; })) {
    r.mutable_slack()->Assign(stats.slack.begin(), stats.slack.end());
  }
  r.set_violations(stats.violations);
  r.set_away_bodies(stats.away_bodies);
  r.set_away_body_ticks(away_body_ticks_);
  r.set_body_ticks(body_ticks_);
  r.set_bytes_sent(links.bytes_sent);
  r.set_frames_sent(links.frames_sent);
  r.set_reconnects(links.reconnects);
  r.set_refused_frames(links.refused_frames + refused_);
  r.set_waits(waits_);
  r.set_wait_us(std::chrono::duration_cast<microseconds>(waited_).count());
  r.mutable_waiting_for()->Add(waiting_for.begin(), waiting_for.end());
  r.set_finished(finished);
  r.set_replaying(replaying_);
  r.set_layout_epoch(region_->phase() == Phase::kJoin ? 0 : region_->layout_epoch());
  r.set_layout_pending(region_->next_layout_at() != 0);
  r.set_left(region_->phase() == Phase::kLeft);
  r.set_lost_us(std::chrono::duration_cast<microseconds>(lost_).count());
  if (journal_ != nullptr) {
    const Journal::Stats journal = journal_->stats();
    r.set_checkpoint_tick(journal.durable_tick);
    r.set_checkpoints(journal.checkpoints);
    r.set_checkpoint_bytes(journal.bytes);
    r.set_checkpoint_write_ms(journal.write_ms);
    r.set_checkpoint_pause_ms(Ms(longest_pause_));
    r.set_storage_failures(journal.failures);
    r.set_storage_failure(journal.last_failure);
    r.set_volume_from(journal.least_tick);
    r.set_keeper(journal.copy.tick > 0 ? journal.copy.keeper + 1 : 0);
    r.set_copied_tick(journal.copy.tick);
    r.set_copy_failures(journal.copy.failures);
    r.set_copy_failure(journal.copy.failure);
    r.set_copy_from(journal.copy.least_tick);
    alone_said_ = journal.copy.alone;
  }
  said_tick_ = r.tick();
  said_bodies_ = r.bodies();
  const bool heard = hooks_.report(r);
  if (finished && hooks_.epilogue) {
    AppendRecentHashes();
    hooks_.epilogue(r, heard);
  }
  if (heard) {
    pending_.Clear();
  } else {
    KeepUnsaid();
  }
  frames_since_report_.clear();
  reported_at_ = now;
  reported_tick_ = region_->tick();
}

}  // namespace aureole
