#include "server/control/layout_run.h"

#include <algorithm>
#include <utility>

#include <google/protobuf/util/message_differencer.h>

#include <absl/strings/str_cat.h>

#include "server/transport/input_codec.h"

namespace aureole {
namespace {

// A change is offered again when nothing is heard of it for so long: the answer may have been lost with a stream.
constexpr std::chrono::seconds kOfferAgain{2};

bool Contains(const std::vector<RegionId>& list, RegionId r) { return std::binary_search(list.begin(), list.end(), r); }

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
  if (desk_ != nullptr) out.wanted = desk_->wanted();
  out.proposed = proposed_;
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
  if (now_.epoch == 0 || status.stage != Stage::kRunning) return;
  if (std::optional<v1::LayoutOutcome> outcome = service_->TakeLayoutOutcome();
      outcome.has_value() && outcome->sequence() == sequence_) {
    outcome_ = std::move(outcome);
  }
  const LayoutStep step = NextLayoutStep(Observe(status));
  switch (step.kind) {
    case LayoutStep::Kind::kNone:
      break;
    case LayoutStep::Kind::kPropose:
      Propose(step.change);
      break;
    case LayoutStep::Kind::kOffer:
      service_->ChangeLayout(step.to, sequence_, *proposed_);
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

void LayoutRun::Propose(const LayoutChange& change) {
  proposed_ = change;
  sequence_ = NextSequence(sequence_);
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
  if (refused_ != outcome_->refused()) {
    tell_(v1::ControlEvent::LAYOUT_REFUSED, kNoRegion,
          absl::StrCat("the layout of epoch ", proposed_->epoch, " was refused: ", outcome_->refused()));
  }
  refused_ = outcome_->refused();
  for (RegionId r : proposed_->members) {
    if (Contains(now_.members, r)) continue;
    ending_.insert(r);
    service_->Dismiss(r, refused_);
  }
  proposed_.reset();
}

void LayoutRun::Ended(RegionId region, bool clean) {
  if (ending_.erase(region) == 0 && (!clean || leaving_.erase(region) == 0)) return;
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
  bool as_wanted = state.wanted.empty() || state.wanted.size() <= now_.regions.size();
  for (size_t i = 0; i < state.wanted.size() && as_wanted; ++i) as_wanted = state.wanted[i] == now_.regions[i];
  const bool idle = std::any_of(now_.members.begin(), now_.members.end(),
                                [this](RegionId r) { return !now_.regions[static_cast<size_t>(r)].HasArea(); });
  state.changing = proposed_.has_value() || !as_wanted || idle || !state.leaving.empty();
  desk_->Publish(std::move(state));
}

}  // namespace aureole
