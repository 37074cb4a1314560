#include "server/control/kubernetes/leader_election.h"

#include <algorithm>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/core/check.h"

namespace aureole::kubernetes {

absl::Status CheckTiming(const ElectionTiming& timing) {
  const auto refuse = [](const char* field, std::chrono::milliseconds is, const char* than,
                         std::chrono::milliseconds limit) {
    return absl::InvalidArgumentError(
        absl::StrCat(field, ": is ", is.count(), " ms, must be ", than, " ", limit.count(), " ms"));
  };
  if (timing.retry.count() <= 0) return refuse("retry", timing.retry, "more than", {});
  if (timing.retry >= timing.renew_deadline) {
    return refuse("retry", timing.retry, "less than the renew deadline of", timing.renew_deadline);
  }
  if (timing.renew_deadline >= timing.duration) {
    return refuse("renew_deadline", timing.renew_deadline, "less than the duration of", timing.duration);
  }
  return absl::OkStatus();
}

LeaderElection::LeaderElection(std::string identity, ElectionTiming timing)
    : identity_(std::move(identity)), timing_(timing) {
  AUREOLE_CHECK(!identity_.empty(), "an elector without an identity");
  const absl::Status checked = CheckTiming(timing_);
  AUREOLE_CHECK(checked.ok(), "%s", checked.ToString().c_str());
}

LeaderElection::Step LeaderElection::Next(Time now) {
  if (leads_ && now >= until()) {
    leads_ = false;
    fresh_ = false;
    next_at_ = now;
  }
  if (resigned_) {
    if (!seen_ || seen_->holder != identity_) return {Action::kWait, Time::max(), {}};
    if (!fresh_) return {Action::kRead, {}, {}};
    Lease released = OwnLease(seen_->transitions, seen_->acquired);
    released.holder.clear();
    released.duration = std::chrono::seconds(1);
    return {Action::kReplace, {}, std::move(released)};
  }
  if (now < next_at_) return {Action::kWait, next_at_, {}};
  if (!fresh_) return {Action::kRead, {}, {}};
  if (leads_) return {Action::kReplace, {}, OwnLease(seen_->transitions, seen_->acquired)};
  const Lease taken = OwnLease(highest_ + 1, "");
  if (!seen_) return {Action::kCreate, {}, taken};
  const Time expires = seen_at_ + Patience();
  if (seen_->holder.empty() || seen_->holder == identity_ || now >= expires) return {Action::kReplace, {}, taken};
  fresh_ = false;
  next_at_ = std::min<Time>(now + timing_.retry, expires);
  return {Action::kWait, next_at_, {}};
}

void LeaderElection::Read(Time now, const std::optional<Lease>& lease) {
  fresh_ = true;
  next_at_ = now;
  if (!lease) {
    seen_.reset();
    leads_ = false;
    return;
  }
  See(now, *lease);
  // Still ours when only the answer to our last renewal was lost.
  leads_ = leads_ && seen_->holder == identity_ && seen_->transitions == highest_;
}

void LeaderElection::Written(Time sent, Time now, const Lease& lease) {
  // A renewal that took until after the deadline: Epoch has said meanwhile that we do not lead, so that this epoch is
  // over. The lease is ours, and the next epoch can be taken at once.
  const bool too_late = leads_ && now >= until();
  See(now, lease);
  fresh_ = true;
  if (resigned_ || too_late) {
    leads_ = false;
    next_at_ = now;
    return;
  }
  leads_ = true;
  renewed_at_ = sent;
  next_at_ = sent + timing_.retry;
}

void LeaderElection::Refused(Time now) {
  fresh_ = false;
  next_at_ = now + timing_.retry / 10;  // soon, but not in a tight loop
}

void LeaderElection::Failed(Time now) {
  fresh_ = false;
  next_at_ = now + timing_.retry;
  if (leads_) next_at_ = std::min<Time>(next_at_, until());
}

void LeaderElection::Resign() {
  leads_ = false;
  resigned_ = true;
}

std::optional<int64_t> LeaderElection::Epoch(Time now) const {
  if (!leads_ || now >= until()) return std::nullopt;
  return seen_->transitions;
}

void LeaderElection::See(Time now, const Lease& lease) {
  if (!seen_ || *seen_ != lease) seen_at_ = now;
  seen_ = lease;
  highest_ = std::max(highest_, lease.transitions);
}

Lease LeaderElection::OwnLease(int64_t transitions, const std::string& acquired) const {
  return {identity_, transitions, std::chrono::ceil<std::chrono::seconds>(timing_.duration), acquired, ""};
}

// For how long the lease must stand still: as its holder says, and not less than we would.
std::chrono::milliseconds LeaderElection::Patience() const {
  return std::max<std::chrono::milliseconds>(seen_->duration, timing_.duration);
}

}  // namespace aureole::kubernetes
