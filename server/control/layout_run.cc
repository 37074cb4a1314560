#include "server/control/layout_run.h"

#include <algorithm>
#include <utility>

#include <absl/strings/str_cat.h>

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

LayoutRun::LayoutRun(ControlService& service, LayoutDesk* desk, int regions,
                     std::function<void(RegionId, const std::string&)> tell)
    : service_(service), desk_(desk), tell_(std::move(tell)), regions_(regions) {
  if (desk_ != nullptr) now_ = desk_->state().now;
}

bool LayoutRun::IsMember(RegionId region) const { return desk_ == nullptr || Contains(now_.members, region); }

bool LayoutRun::WantsServer(RegionId region) const {
  const bool joins = proposed_.has_value() && Contains(proposed_->members, region);
  return IsMember(region) || joins || Leaves(region);
}

LayoutObserved LayoutRun::Observe(const RunStatus& status) const {
  LayoutObserved out;
  out.now = now_;
  out.wanted = desk_->wanted();
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
  if (desk_ == nullptr || status.stage != Stage::kRunning) return;
  if (std::optional<v1::LayoutOutcome> outcome = service_.TakeLayoutOutcome();
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
      service_.ChangeLayout(step.to, sequence_, *proposed_);
      offer_ = {step.to, status.regions[static_cast<size_t>(step.to)].incarnation, Clock::now()};
      break;
    case LayoutStep::Kind::kAdopt:
      Adopt();
      break;
    case LayoutStep::Kind::kDrop:
      Drop();
      break;
  }
  Publish();
}

void LayoutRun::Propose(const LayoutChange& change) {
  proposed_ = change;
  sequence_ = NextSequence(sequence_);
  offer_.reset();
  outcome_.reset();
  for (RegionId r : change.members) {
    if (Contains(now_.members, r)) continue;
    regions_ = std::max(regions_, r + 1);
    service_.Admit(r, change);
    tell_(r, absl::StrCat("joins with the layout of epoch ", change.epoch));
  }
}

void LayoutRun::Adopt() {
  for (RegionId r : now_.members) {
    if (Contains(proposed_->members, r)) continue;
    leaving_.insert(r);
    tell_(r, absl::StrCat("leaves with the layout of epoch ", proposed_->epoch));
  }
  now_ = *std::exchange(proposed_, std::nullopt);
  refused_.clear();
  service_.SetLayout(now_);
  tell_(kNoRegion,
        absl::StrCat("the layout of epoch ", now_.epoch, " is in force, of ", now_.members.size(), " regions"));
}

void LayoutRun::Drop() {
  if (refused_ != outcome_->refused()) {
    tell_(kNoRegion, absl::StrCat("the layout of epoch ", proposed_->epoch, " was refused: ", outcome_->refused()));
  }
  refused_ = outcome_->refused();
  for (RegionId r : proposed_->members) {
    if (Contains(now_.members, r)) continue;
    ending_.insert(r);
    service_.Dismiss(r, refused_);
  }
  proposed_.reset();
}

void LayoutRun::Ended(RegionId region, bool clean) {
  if (ending_.erase(region) == 0 && (!clean || leaving_.erase(region) == 0)) return;
  service_.Retire(region);
  tell_(region, "has left");
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
