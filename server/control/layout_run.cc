#include "server/control/layout_run.h"

#include <algorithm>
#include <utility>

#include <google/protobuf/util/message_differencer.h>

#include <absl/strings/str_cat.h>

#include "server/control/layout_plan.h"
#include "server/transport/input_codec.h"

namespace aureole {
namespace {

// A change is offered again when nothing is heard of it for so long: the answer may have been lost with a stream.
constexpr std::chrono::seconds kOfferAgain{2};

bool Contains(const std::vector<RegionId>& list, RegionId r) { return std::binary_search(list.begin(), list.end(), r); }

Rect AreaOf(const std::vector<Rect>& regions, RegionId r) {
  return static_cast<size_t>(r) < regions.size() ? regions[static_cast<size_t>(r)] : Rect{};
}

// Grows from one control plane of a world to the next.
uint64_t NextSequence(uint64_t last) {
  const auto now =
      std::chrono::duration_cast<std::chrono::microseconds>(std::chrono::system_clock::now().time_since_epoch())
          .count();
  return std::max(last + 1, static_cast<uint64_t>(now));
}

}  // namespace

LayoutRun::LayoutRun(LayoutDesk* desk, int regions, Tell tell)
    : desk_(desk), tell_(std::move(tell)), regions_(regions) {
  if (desk_ != nullptr) now_ = desk_->state().now;
}

absl::Status LayoutRun::Restore(const v1::WorldRecord& record) {
  regions_ = std::max(regions_, record.regions_size());
  if (!record.has_layout()) return absl::OkStatus();
  LayoutChange now, proposed, wanted;
  for (const auto& [from, to] : {std::pair(&record.layout(), &now), std::pair(&record.proposed(), &proposed),
                                 std::pair(&record.wanted(), &wanted)}) {
    if (absl::Status s = DecodeLayoutChange(*from, to); !s.ok()) return absl::FailedPreconditionError(s.message());
  }
  now_ = std::move(now);
  if (record.has_proposed()) proposed_ = std::move(proposed);
  offered_ = record.has_proposed();
  sequence_ = record.layout_sequence();
  leaving_ = {record.leaving().begin(), record.leaving().end()};
  for (int i = 0; i < record.regions_size(); ++i) {
    if (record.regions(i).has_joins()) joins_[i] = record.regions(i).joins();
  }
  if (desk_ == nullptr) return absl::OkStatus();
  Publish();
  if (wanted.regions.empty()) return absl::OkStatus();
  return desk_->Want([&](const LayoutChange&, const LayoutDesk::State&) { return wanted.regions; });
}

bool LayoutRun::Keep(v1::WorldRecord* record) {
  if (now_.epoch == 0) return false;
  v1::WorldRecord next;
  EncodeLayoutChange(now_, next.mutable_layout());
  if (proposed_.has_value()) EncodeLayoutChange(*proposed_, next.mutable_proposed());
  next.set_layout_sequence(sequence_);
  LayoutChange wanted;
  if (desk_ != nullptr) wanted.regions = desk_->wanted();
  if (!wanted.regions.empty()) EncodeLayoutChange(wanted, next.mutable_wanted());
  for (RegionId r : leaving_) next.add_leaving(r);
  for (const auto& [r, joins] : joins_) *record->mutable_regions(r)->mutable_joins() = joins;
  v1::WorldRecord last;
  if (record->has_layout()) *last.mutable_layout() = record->layout();
  if (record->has_proposed()) *last.mutable_proposed() = record->proposed();
  last.set_layout_sequence(record->layout_sequence());
  if (record->has_wanted()) *last.mutable_wanted() = record->wanted();
  *last.mutable_leaving() = record->leaving();
  if (google::protobuf::util::MessageDifferencer::Equals(last, next)) return false;
  record->clear_proposed();
  record->clear_wanted();
  record->clear_leaving();
  record->MergeFrom(next);
  *record->mutable_layout() = next.layout();
  if (next.has_proposed()) *record->mutable_proposed() = next.proposed();
  return true;
}

// Without a desk, and nothing kept, the layout is the world's for ever.
bool LayoutRun::IsMember(RegionId region) const { return now_.epoch == 0 || Contains(now_.members, region); }

bool LayoutRun::WantsServer(RegionId region) const {
  const bool joins = proposed_.has_value() && Contains(proposed_->members, region);
  return IsMember(region) || joins || Leaves(region);
}

LayoutObserved LayoutRun::Observe(const RunStatus& status) const {
  LayoutObserved out;
  out.now = now_;
  out.wanted = Wish();
  out.proposed = proposed_;
  out.withdrawn = withdrawn_;
  for (size_t i = 0; i < status.regions.size(); ++i) {
    const auto r = static_cast<RegionId>(i);
    const RegionStatus& from = status.regions[i];
    const bool free = !WantsServer(r) && !ending_.contains(r);
    out.regions.push_back(
        {from.ready && !from.left, from.report.may_join(), free, from.report.layout_epoch(), from.report.bodies()});
  }
  if (offer_.has_value()) {
    const RegionStatus& to = status.regions[static_cast<size_t>(offer_->to)];
    out.offered = to.incarnation == offer_->incarnation && Clock::now() - offer_->at < kOfferAgain;
  }
  out.refused = outcome_.has_value() && !outcome_->refused().empty();
  out.accepted = outcome_.has_value() && outcome_->refused().empty() && outcome_->tick() > 0;
  return out;
}

void LayoutRun::Step(const RunStatus& status) {
  LetLeave(status);
  if (now_.epoch == 0 || status.stage != Stage::kRunning) return;
  if (std::optional<v1::LayoutOutcome> outcome = service_->TakeLayoutOutcome();
      outcome.has_value() && outcome->sequence() == sequence_) {
    outcome_ = std::move(outcome);
  }
  for (RegionId r : ending_) service_->Dismiss(r, refused_);  // it may have come only now
  WatchStandIns();
  const LayoutStep step = NextLayoutStep(Observe(status));
  switch (step.kind) {
    case LayoutStep::Kind::kNone:
      break;
    case LayoutStep::Kind::kPropose:
      Propose(step.change);
      break;
    case LayoutStep::Kind::kOffer:
      service_->ChangeLayout(step.to, sequence_, *proposed_);
      offered_ = true;
      offer_ = {step.to, status.regions[static_cast<size_t>(step.to)].incarnation, Clock::now()};
      break;
    case LayoutStep::Kind::kAdopt:
      Adopt();
      break;
    case LayoutStep::Kind::kDrop:
      Drop();
      break;
  }
  if (desk_ != nullptr) Publish();
}

void LayoutRun::LetLeave(const RunStatus& status) {
  for (size_t i = 0; i < status.regions.size(); ++i) {
    const RegionStatus& from = status.regions[i];
    if (!from.leaves_by.has_value()) continue;
    const auto r = static_cast<RegionId>(i);
    absl::Status s = absl::FailedPreconditionError("the world does not run");
    if (status.stage == Stage::kRunning && !from.finished) s = StandIn(r, from);
    if (from.asks_to_leave || !s.ok()) service_->AnswerLeaving(r, std::string(s.message()));
  }
}

absl::Status LayoutRun::StandIn(RegionId region, const RegionStatus& status) {
  if (now_.epoch == 0) return absl::FailedPreconditionError("the layout of this run does not change");
  const std::vector<Rect> wanted = desk_ == nullptr ? now_.regions : desk_->wanted();
  if (!AreaOf(wanted.empty() ? now_.regions : wanted, region).HasArea()) return absl::OkStatus();
  if (desk_ == nullptr) return absl::FailedPreconditionError("the layout of this run does not change");
  RegionId by = kNoRegion;
  absl::Status s =
      desk_->Want([&](const LayoutChange& now, const LayoutDesk::State& state) -> absl::StatusOr<std::vector<Rect>> {
        absl::StatusOr<aureole::StandIn> out = WithStandIn(now, region, state.leaving);
        if (!out.ok()) return out.status();
        by = out->region;
        return std::move(out->regions);
      });
  if (!s.ok()) return s;
  const auto now = Clock::now();
  stand_ins_[region] = {by, now + (*status.leaves_by - now) / 2};
  tell_(v1::ControlEvent::REGION_LEAVES, region,
        absl::StrCat("leaves: its server was told to end; region ", by, " takes its place"));
  return absl::OkStatus();
}

// When one is late, all that have not come yet are: a change waits for all that are to join with it.
void LayoutRun::WatchStandIns() {
  std::erase_if(stand_ins_, [this](const auto& entry) { return IsMember(entry.second.by); });
  const auto all = [this](auto holds) {
    return std::all_of(stand_ins_.begin(), stand_ins_.end(), [&](const auto& entry) { return holds(entry.second); });
  };
  if (all([](const Place& p) { return p.left; })) {
    stand_ins_.clear();
    late_ = false;
  }
  const auto now = Clock::now();
  if (late_ || (proposed_.has_value() && offered_) || all([&](const Place& p) { return now < p.late_from; })) return;
  late_ = true;
  if (Wish() == desk_->wanted()) {  // no neighbour can have it
    late_ = false;
    return;
  }
  withdrawn_ = proposed_.has_value();
  for (const auto& [region, place] : stand_ins_) {
    tell_(v1::ControlEvent::REGION_LATE, place.by,
          absl::StrCat("does not come in time; a neighbour has the area of region ", region, " meanwhile"));
  }
}

// The region's server has ended and it has not left, so its next one goes on with what it had, unless the stand-in may
// be about to join.
void LayoutRun::TakeBack(RegionId region) {
  const auto found = stand_ins_.find(region);
  if (found == stand_ins_.end()) return;
  const RegionId by = found->second.by;
  const bool joins = proposed_.has_value() && Contains(proposed_->members, by);
  stand_ins_.erase(found);
  if (IsMember(by) || (joins && offered_)) return;
  withdrawn_ |= joins;
  const absl::Status s = desk_->Want([&](const LayoutChange& now, const LayoutDesk::State&) {
    std::vector<Rect> out = now.regions;
    const auto from = static_cast<size_t>(by), to = static_cast<size_t>(region);
    if (from < out.size() && to < out.size() && !out[to].HasArea()) std::swap(out[from], out[to]);
    return out;
  });
  tell_(v1::ControlEvent::REGION_STAYS, region,
        s.ok() ? "did not leave; it keeps its place" : std::string(s.message()));
}

// What operators want, as far as there are servers for it.
std::vector<Rect> LayoutRun::Wish() const {
  LayoutChange wish = now_;
  wish.regions = desk_ == nullptr ? std::vector<Rect>() : desk_->wanted();
  if (!late_) return wish.regions;
  while (wish.ranks.size() < wish.regions.size()) wish.ranks.push_back(static_cast<int>(wish.ranks.size()));
  for (const auto& [region, place] : stand_ins_) {
    absl::StatusOr<std::vector<Rect>> without = WithoutArea(wish, place.by);
    if (without.ok()) wish.regions = *std::move(without);
  }
  return wish.regions;
}

void LayoutRun::Propose(const LayoutChange& change) {
  proposed_ = change;
  sequence_ = NextSequence(sequence_);
  offered_ = withdrawn_ = false;
  offer_.reset();
  outcome_.reset();
  tell_(v1::ControlEvent::LAYOUT_PROPOSED, kNoRegion,
        absl::StrCat("a layout of epoch ", change.epoch, " is proposed, of ", change.members.size(), " regions"));
  for (RegionId r : change.members) {
    if (Contains(now_.members, r)) continue;
    regions_ = std::max(regions_, r + 1);
    EncodeLayoutChange(change, &(joins_[r] = {}));
    service_->Admit(r, change);
    tell_(v1::ControlEvent::REGION_JOINS, r, absl::StrCat("joins with the layout of epoch ", change.epoch));
  }
}

void LayoutRun::Adopt() {
  for (RegionId r : now_.members) {
    if (Contains(proposed_->members, r)) continue;
    leaving_.insert(r);
    tell_(v1::ControlEvent::REGION_LEAVES, r, absl::StrCat("leaves with the layout of epoch ", proposed_->epoch));
  }
  now_ = *std::exchange(proposed_, std::nullopt);
  refused_.clear();
  service_->SetLayout(now_);
  tell_(v1::ControlEvent::LAYOUT_IN_FORCE, kNoRegion,
        absl::StrCat("the layout of epoch ", now_.epoch, " is in force, of ", now_.members.size(), " regions"));
}

void LayoutRun::Drop() {
  const std::string why = withdrawn_ ? "a region that was to join has not come in time" : outcome_->refused();
  if (refused_ != why) {
    tell_(
        v1::ControlEvent::LAYOUT_REFUSED, kNoRegion,
        absl::StrCat("the layout of epoch ", proposed_->epoch, withdrawn_ ? " is given up: " : " was refused: ", why));
  }
  refused_ = why;
  for (RegionId r : proposed_->members) {
    if (Contains(now_.members, r)) continue;
    ending_.insert(r);
    service_->Dismiss(r, refused_);
  }
  proposed_.reset();
  withdrawn_ = false;
}

void LayoutRun::Ended(RegionId region, bool clean) {
  service_->AnswerLeaving(region, "its server has ended");  // it asks no more
  if (!Leaves(region)) TakeBack(region);
  if (ending_.erase(region) == 0 && (!clean || leaving_.erase(region) == 0)) return;
  if (const auto place = stand_ins_.find(region); place != stand_ins_.end()) place->second.left = true;
  service_->Retire(region);
  tell_(v1::ControlEvent::REGION_LEFT, region, "has left");
}

void LayoutRun::Publish() const {
  LayoutDesk::State state;
  state.now = now_;
  state.wanted = desk_->wanted();
  state.leaving = {leaving_.begin(), leaving_.end()};
  state.leaving.insert(state.leaving.end(), ending_.begin(), ending_.end());
  state.refused = refused_;
  bool as_wanted = true;
  for (size_t i = 0; i < state.wanted.size() && as_wanted; ++i) {
    as_wanted = state.wanted[i] == AreaOf(now_.regions, static_cast<RegionId>(i));
  }
  const bool idle = std::any_of(now_.members.begin(), now_.members.end(),
                                [this](RegionId r) { return !now_.regions[static_cast<size_t>(r)].HasArea(); });
  state.changing = proposed_.has_value() || !as_wanted || idle || !state.leaving.empty();
  desk_->Publish(std::move(state));
}

}  // namespace aureole
