// How a running world comes from the layout in force to a wanted one, step by step, as a pure function of what is seen:
// no clock, process or socket.
//
// A region that is new has a server that has met all others before the world hears of it. One that is to go first loses
// its area, then its bodies, then its membership; its server ends by itself. So a wanted layout takes one change or
// two, one at a time. A server that dies meanwhile is replaced, and does again what it had done; a change that was
// offered to it is offered again, and acts once.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "server/core/scene.h"
#include "server/core/world.h"

namespace aureole {

// A region, as its server was seen last.
struct RegionSeen {
  bool ready = false;     // has loaded the world, and its stream is open
  bool may_join = false;  // waits for its welcome, and has met all others
  bool free = true;       // no region has this name: none had, or it has left and its server has ended
  uint64_t epoch = 0;     // of the layout that it has reported; 0: none yet
  int64_t bodies = 0;
};

struct LayoutObserved {
  LayoutChange now;          // in force
  std::vector<Rect> wanted;  // by region, as in LayoutChange; empty: nothing else
  std::optional<LayoutChange> proposed;
  bool offered = false;    // to a server that is still there, and has not answered
  bool accepted = false;   // it has answered: `proposed` is in force
  bool refused = false;    // it has answered: `proposed` comes to nothing
  bool withdrawn = false;  // nobody has been offered `proposed`, nor is anybody to be
  std::vector<RegionSeen> regions;
};

struct LayoutStep {
  enum class Kind {
    kNone,
    kPropose,  // `change`: from here on its new members need servers
    kOffer,    // what is proposed, to region `to`
    kAdopt,    // what is proposed is in force
    kDrop      // what is proposed has come to nothing
  };
  Kind kind = Kind::kNone;
  LayoutChange change = {};
  RegionId to = kNoRegion;
};

LayoutStep NextLayoutStep(const LayoutObserved& observed);

// The layout with which a world begins.
LayoutChange FirstLayout(const World& world);

}  // namespace aureole
