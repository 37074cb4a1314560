#include "server/core/division.h"

#include <algorithm>
#include <numeric>

#include <absl/strings/str_cat.h>

#include "server/core/check.h"
#include "server/core/limits.h"

namespace aureole {
namespace {

bool Contains(const std::vector<RegionId>& list, RegionId r) { return std::binary_search(list.begin(), list.end(), r); }

std::vector<RegionId> All(const Layout& layout) {
  std::vector<RegionId> all(static_cast<size_t>(layout.size()));
  std::iota(all.begin(), all.end(), 0);
  return all;
}

}  // namespace

absl::StatusOr<Layout> LayoutOf(const LayoutChange& change) {
  if (change.regions.size() > size_t{limits::kMaxRegions}) {
    return absl::InvalidArgumentError(
        absl::StrCat("regions: must be at most ", limits::kMaxRegions, ", are ", change.regions.size()));
  }
  absl::StatusOr<Layout> layout = Layout::WithRanks(change.regions, change.ranks);
  if (!layout.ok()) return layout;
  for (size_t i = 0; i < change.members.size(); ++i) {
    const RegionId r = change.members[i];
    if (r < 0 || r >= layout->size() || (i > 0 && r <= change.members[i - 1])) {
      return absl::InvalidArgumentError(
          absl::StrCat("members[", i, "]: must be a region, and greater than the one before it; is ", r));
    }
  }
  for (RegionId r = 0; r < layout->size(); ++r) {
    if (!layout->has_area(r) || Contains(change.members, r)) continue;
    return absl::InvalidArgumentError(
        absl::StrCat("members: must name region ", r, ", which has an area; or give it none"));
  }
  return layout;
}

bool Division::State::IsMember(RegionId r) const { return Contains(members, r); }

Division::Division(const Layout& layout) : now_{layout, kFirstLayoutEpoch, All(layout)}, next_(now_) {}

Division::Division(const LayoutChange& change) : now_{*LayoutOf(change), change.epoch, change.members}, next_(now_) {}

const Division::State* Division::At(Tick n, Tick stepped) const {
  // A change that nobody has heard of yet is heard in the next tick at the earliest, and not before the pending one is
  // in force.
  if (n > std::max(stepped, next_at_ - 1) + kLayoutNotice) return nullptr;
  return next_at_ > 0 && n >= next_at_ ? &next_ : &now_;
}

absl::Status Division::Check(const LayoutChange& change) const {
  if (next_at_ > 0) {
    return absl::FailedPreconditionError(
        absl::StrCat("another change takes effect at the start of tick ", next_at_, "; ask again after it"));
  }
  if (change.epoch != now_.epoch + 1) {
    return absl::FailedPreconditionError(
        absl::StrCat("epoch: is ", change.epoch, ", but that of the layout in force is ", now_.epoch));
  }
  if (static_cast<int>(change.regions.size()) < now_.layout.size()) {
    return absl::FailedPreconditionError(
        absl::StrCat("regions: are ", change.regions.size(), ", but must be at least ", now_.layout.size(),
                     ", as now: one that is given up stays in the list, without area"));
  }
  for (RegionId r : now_.members) {
    if (Contains(change.members, r) || IsEmptied(r)) continue;
    return absl::FailedPreconditionError(absl::StrCat(
        "members: must name region ", r, ", which holds bodies; first take its area, then wait until they have left"));
  }
  return absl::OkStatus();
}

absl::Status Division::Deliver(const LayoutChange& change, Tick effect) {
  if (absl::Status s = Check(change); !s.ok()) return s;
  next_ = {*LayoutOf(change), change.epoch, change.members};
  next_at_ = effect;
  return absl::OkStatus();
}

void Division::Adopt(Tick n) {
  AUREOLE_CHECK(n == next_at_, "layout of epoch %llu, of tick %lld, adopted at tick %lld",
                static_cast<unsigned long long>(next_.epoch), static_cast<long long>(next_at_),
                static_cast<long long>(n));
  now_ = next_;
  next_at_ = 0;
  std::erase_if(emptied_, [this](RegionId r) { return !now_.IsMember(r) || now_.layout.has_area(r); });
}

}  // namespace aureole
