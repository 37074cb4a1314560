#include "server/control/checkpoint_desk.h"

#include <utility>

#include <absl/strings/str_cat.h>

#include "server/core/check.h"

namespace aureole {
namespace {

// All servers hear of it before they come there: reports are up to 200 ms old.
constexpr int64_t kMarginUs = 500'000;
// A server that died meanwhile has not heard.
constexpr std::chrono::seconds kAskAgain{1};

absl::Status Over() { return absl::UnavailableError("the run is over, or its control plane leaves; ask the next one"); }

}  // namespace

CheckpointDesk::CheckpointDesk(Tick every, int64_t tick_us) : every_(every), margin_(1 + kMarginUs / tick_us) {}

CheckpointDesk::~CheckpointDesk() { AUREOLE_CHECK(wishes_.empty(), "somebody still waits for a checkpoint"); }

void CheckpointDesk::Ask(bool copied, Done done) {
  absl::Status s;
  {
    const std::lock_guard lock(mutex_);
    if (closed_) {
      s = Over();
    } else if (every_ == 0) {
      s = absl::FailedPreconditionError("this run makes no checkpoints; start it with --checkpoint-every");
    } else if (wishes_.size() >= kMostWaiting) {
      s = absl::ResourceExhaustedError(absl::StrCat("at most ", kMostWaiting, " calls may wait; try later"));
    } else {
      wishes_.push_back({copied, std::move(done)});
    }
  }
  if (!s.ok()) done(s, {});
}

bool CheckpointDesk::Serve(Wish* wish, const RunStatus& status, const std::function<void(RegionId, Tick)>& save) const {
  const auto now = Clock::now();
  if (wish->tick == 0) wish->tick = status.MaxTick() + margin_;
  const bool ask = now - wish->asked >= kAskAgain;
  if (ask) wish->asked = now;
  v1::SaveCheckpointResponse response;
  response.set_tick(wish->tick);
  bool all = true;
  absl::Status s;
  for (size_t i = 0; i < status.regions.size(); ++i) {
    const RegionStatus& r = status.regions[i];
    if (!r.member) continue;
    const auto region = static_cast<RegionId>(i);
    v1::SavedRegion* saved = response.add_regions();
    saved->set_region(region);
    saved->set_tick(r.report.checkpoint_tick());
    saved->set_copied_tick(r.report.copied_tick());
    const bool written = saved->tick() >= wish->tick, copied = !wish->copied || saved->copied_tick() >= wish->tick;
    all &= written && copied;
    const std::string& failure = written ? r.report.copy_failure() : r.report.storage_failure();
    if (!(written && copied) && !failure.empty()) {
      s = absl::UnavailableError(absl::StrCat(
          "region ", region, written ? " has no copy: " : " cannot write: ", failure, "; mend that, then ask again"));
    }
    if (!written && ask) save(region, wish->tick);
  }
  if (wish->copied && response.regions_size() == 1) {
    s = absl::FailedPreconditionError("copied: must not be set for a world of one region, which has no neighbour");
  }
  if (s.ok() && !all) return false;
  wish->done(s, s.ok() ? response : v1::SaveCheckpointResponse());
  return true;
}

void CheckpointDesk::Step(const RunStatus& status, const std::function<void(RegionId, Tick)>& save) {
  const std::lock_guard lock(mutex_);
  if (status.stage != Stage::kRunning) return;
  std::erase_if(wishes_, [&](Wish& wish) { return Serve(&wish, status, save); });
}

void CheckpointDesk::Close() {
  const std::lock_guard lock(mutex_);
  closed_ = true;
  for (Wish& wish : wishes_) wish.done(Over(), {});
  wishes_.clear();
}

}  // namespace aureole
