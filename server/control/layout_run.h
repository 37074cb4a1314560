// Carries out the changes of one run's layout, one step at each look at its servers (layout_change.h), and knows which
// regions have a server.
//
// A server that was told to end (RegionStatus::leaves_by) leaves by such changes too: what is wanted is then wanted of
// a stand-in, a region that is free, and so the old one leaves as it loses its area. When the stand-in's server does
// not come in time, a neighbour has the area until the old one has left.
#pragma once

#include <chrono>
#include <functional>
#include <map>
#include <optional>
#include <set>
#include <string>

#include <absl/status/status.h>

#include "aureole/v1/world_record.pb.h"
#include "server/control/control_service.h"
#include "server/control/layout_change.h"
#include "server/control/layout_desk.h"
#include "server/control/run_event.h"
#include "server/control/run_status.h"

namespace aureole {

// One thread at a time.
class LayoutRun {
 public:
  // All outlive it. `desk`: null: the layout stays as it is. `tell`: what happens, for people.
  using Tell = std::function<void(EventKind, RegionId, const std::string&)>;
  LayoutRun(LayoutDesk* desk, int regions, Tell tell);

  // What an earlier control plane has kept, before anything else. FailedPrecondition: it is no layout.
  absl::Status Restore(const v1::WorldRecord& record);
  // From here on servers join there.
  void Serve(ControlService* service) { service_ = service; }
  // Writes what the next control plane must know; true when that has changed since the last call.
  bool Keep(v1::WorldRecord* record);

  // At each look.
  void Step(const RunStatus& status);
  // The region's server has ended; `clean`: in order.
  void Ended(RegionId region, bool clean);

  // Of the list, which only grows.
  int regions() const { return regions_; }
  // Whether the region is to have a server: it is a member, will be, or its server has yet to leave in order.
  bool WantsServer(RegionId region) const;
  bool IsMember(RegionId region) const;
  // Of the layout in force, as far as is known.
  uint64_t epoch() const { return now_.epoch == 0 ? kFirstLayoutEpoch : now_.epoch; }
  // Its server ends by itself, and gets no next one then.
  bool Leaves(RegionId region) const { return leaving_.contains(region); }

 private:
  using Clock = std::chrono::steady_clock;
  struct Place {
    RegionId by = kNoRegion;      // the stand-in
    Clock::time_point late_from;  // unless it has joined
    bool left = false;            // the region whose place it takes, and its server has ended
  };
  struct Offer {
    RegionId to = kNoRegion;
    uint64_t incarnation = 0;
    Clock::time_point at;
  };

  // Regions whose servers were told to end.
  void LetLeave(const RunStatus& status);
  absl::Status StandIn(RegionId region, const RegionStatus& status);
  void WatchStandIns();
  void TakeBack(RegionId region);
  std::vector<Rect> Wish() const;
  LayoutObserved Observe(const RunStatus& status) const;
  void Propose(const LayoutChange& change);
  void Adopt();
  void Drop();
  void Publish() const;

  ControlService* service_ = nullptr;
  LayoutDesk* const desk_;
  const Tell tell_;
  int regions_;
  LayoutChange now_;
  std::optional<LayoutChange> proposed_;
  uint64_t sequence_ = 0;
  std::optional<Offer> offer_;
  bool offered_ = false;    // what is proposed, to anybody, as far as is known
  bool withdrawn_ = false;  // what is proposed, and was not offered
  std::optional<v1::LayoutOutcome> outcome_;
  std::string refused_;
  std::map<RegionId, v1::LayoutChange> joins_;
  std::set<RegionId> leaving_;           // no members any more, and their servers have not ended
  std::map<RegionId, Place> stand_ins_;  // by the region that leaves; of whom the stand-in has not joined
  bool late_ = false;                    // neighbours have what stand-ins are to have
  std::set<RegionId> ending_;            // were to join and will not; their servers have been told to end
};

}  // namespace aureole
