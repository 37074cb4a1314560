// How a running world is divided between regions, now and from a tick to come on.
//
// A change is an input of the control plane: told to all with the exchange, so that all regions hear it in the same
// tick and adopt it at the start of the same later one. Of changes one is pending at a time.
#pragma once

#include <set>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/core/partition.h"
#include "server/core/scene.h"

namespace aureole {

// Of the layout with which a world begins.
inline constexpr uint64_t kFirstLayoutEpoch = 1;
// From the tick in which all hear of a change to the one at whose start they adopt it.
inline constexpr Tick kLayoutNotice = 8;

// The layout that a change describes. InvalidArgument names the field when it describes none, or leaves a region that
// has an area without a server.
absl::StatusOr<Layout> LayoutOf(const LayoutChange& change);

class Division {
 public:
  // What is in force in a tick.
  struct State {
    Layout layout;
    uint64_t epoch = kFirstLayoutEpoch;
    std::vector<RegionId> members;  // those that have a server and take part in the exchange, ascending

    bool IsMember(RegionId r) const;

    template <class Archive>
    void Visit(Archive& a) {
      a(layout, epoch, members);
    }
  };

  // The world's own layout; every region is a member.
  explicit Division(const Layout& layout);
  // A layout of a world that runs. Precondition: LayoutOf(change).ok().
  explicit Division(const LayoutChange& change);

  const State& now() const { return now_; }
  // What will be in force from tick next_at() on; next_at() is 0 when no change is pending.
  const State& next() const { return next_; }
  Tick next_at() const { return next_at_; }
  // What is in force in tick n, after tick `stepped`; null when n is so late that it is not known yet.
  const State* At(Tick n, Tick stepped) const;

  // The rest is called alike in all regions. A change that takes effect at the start of tick `effect`, or has no
  // effect: FailedPrecondition says why. Precondition: LayoutOf(change).ok().
  absl::Status Deliver(const LayoutChange& change, Tick effect);
  // Precondition: n is next_at(), the tick that begins.
  void Adopt(Tick n);
  // A member without area has no bodies, and will get none: it may be left out of the next layout.
  void Emptied(RegionId region) { emptied_.insert(region); }
  bool IsEmptied(RegionId region) const { return emptied_.contains(region); }

  template <class Archive>
  void Visit(Archive& a) {
    a(now_, next_, next_at_, emptied_);
  }

 private:
  absl::Status Check(const LayoutChange& change) const;

  State now_, next_;
  Tick next_at_ = 0;
  std::set<RegionId> emptied_;
};

}  // namespace aureole
