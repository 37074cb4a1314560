#include "server/control/reconcile.h"

#include <algorithm>
#include <cmath>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>

namespace aureole {
namespace {

// Why a server that runs is given up; empty when it is not. One that cannot be replaced is waited for.
std::string Lost(const RegionObserved& r, bool recovers) {
  if (r.joined && !r.connected && r.silent_s > kExitAfterLeaveSeconds) return "its stream ended";
  if (recovers && r.joined && r.silent_s > kLeaseSeconds)
    return absl::StrFormat("nothing heard of it for %.1f s", r.silent_s);
  if (r.adopted && !r.joined && r.silent_s > kRejoinSeconds) return "it has not joined again";
  return "";
}

void ReconcileRegion(RegionId region, const RegionObserved& r, bool recovers, std::vector<Action>* out) {
  const auto act = [&](Action::Kind kind, uint64_t incarnation, std::string why) {
    out->push_back({kind, region, incarnation, std::move(why)});
  };
  // One that has joined is told to end, and does.
  if (!r.wanted && r.alive && !r.joined) return act(Action::Kind::kEnd, r.incarnation, "it is not needed any more");
  if (!r.wanted || (r.leaves && !r.alive && r.clean)) return;
  if (r.joins) return act(Action::Kind::kStart, r.incarnation + 1, "the region joins the world");
  if (r.incarnation == 0) return act(Action::Kind::kStart, 1, "the world begins");
  const std::string lost = r.alive ? Lost(r, recovers) : r.how;
  if (lost.empty() || (!r.alive && r.clean && r.finished)) return;
  // Who is to join is tried again: the world goes on without.
  if (!recovers || (r.member && r.failures >= kMostFailures)) return act(Action::Kind::kGiveUp, r.incarnation, lost);
  // Two servers of a region must not write to one directory: the next one starts when the allocator says that the last
  // one is gone.
  if (r.alive) return act(Action::Kind::kEnd, r.incarnation, lost);
  if (r.down_s >= BackOffSeconds(r.failures)) act(Action::Kind::kStart, r.incarnation + 1, lost);
}

}  // namespace

double BackOffSeconds(int failures) { return failures == 0 ? 0 : std::min(10.0, 0.1 * std::pow(2, failures - 1)); }

std::vector<Action> Reconcile(const Observed& observed) {
  std::vector<Action> out;
  if (observed.over) return out;
  for (size_t i = 0; i < observed.regions.size(); ++i) {
    ReconcileRegion(static_cast<RegionId>(i), observed.regions[i], observed.recovers, &out);
  }
  return out;
}

}  // namespace aureole
