// What the control plane tells of a run, for people and for programs.
#pragma once

#include <chrono>
#include <cstdint>
#include <string>

#include "aureole/v1/control_plane.pb.h"
#include "server/core/types.h"

namespace aureole {

using EventKind = v1::ControlEvent::Kind;

// Something that the control plane has decided, or has seen happen.
struct RunEvent {
  std::chrono::system_clock::time_point time;
  EventKind kind = v1::ControlEvent::UNKNOWN;
  RegionId region = kNoRegion;  // kNoRegion: the world
  std::string what;
  uint64_t sequence = 0;  // greater than those before; EventLog gives it
};

// Whether somebody should look.
bool IsWarning(EventKind kind);
// For people: what happened, and to which region.
std::string TextOf(const RunEvent& event);
// RegionEnded, and so on.
std::string NameOf(EventKind kind);

}  // namespace aureole
