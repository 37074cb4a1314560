// A seeded network between regions, in virtual time: every link loses connections and repeats messages, and LinkSender
// and LinkReceiver make exactly-once, in-order delivery of it.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <queue>
#include <set>
#include <vector>

#include "server/core/frame.h"
#include "server/core/link.h"
#include "tests/simulation/cluster.h"
#include "tests/simulation/random.h"

namespace aureole::sim {

class Network {
 public:
  Network(int regions, uint64_t seed, const Faults& faults);

  // A region that may speak with all others from now on; and one that will never again: what is under way is lost.
  void Add(RegionId region);
  void Remove(RegionId region);

  void Send(RegionId from, RegionId to, std::shared_ptr<const Frame> frame);
  // Runs `fn` for the region at a later time of its own choosing.
  void Wake(RegionId region, int64_t delay_us);
  // Delivers the next event. `deliver` gets frames; `wake` gets regions that were stalled. False when nothing is under
  // way.
  bool RunNext(const std::function<void(RegionId to, const Frame&)>& deliver,
               const std::function<void(RegionId)>& wake);

  // A region dies: what is under way to and from it is lost, and nothing more reaches it.
  void Down(RegionId region);
  // Of a region: what it keeps for each peer.
  using Senders = std::map<RegionId, LinkSender<std::shared_ptr<const Frame>>>;
  Senders SendersOf(RegionId region) const;
  // It is back: it goes on with what it kept then, and has taken so many frames of each peer. Of a
  // peer that is not named, because it was none then, it has taken what it had said to be durable.
  void Up(RegionId region, const Senders& senders, const std::map<RegionId, uint64_t>& taken);
  // All that it speaks with are up, and none has had a frame of it that it has not sent again since it was down.
  bool CaughtUp(RegionId region) const;
  // With crashes, frames are kept until the receiver says that they are durable there.
  void Durable(RegionId region, const std::map<RegionId, uint64_t>& taken);

  int64_t reconnects() const { return reconnects_; }
  int64_t duplicates() const { return duplicates_; }

 private:
  struct Link {
    LinkSender<std::shared_ptr<const Frame>> sender;
    LinkReceiver receiver;
    uint64_t connection = 0;
    int64_t base_us = 0, last_arrival_us = 0;
  };
  struct Event {
    int64_t at_us;
    uint64_t order;
    enum class Kind { kFrame, kReconnect, kWake } kind;
    RegionId from, to;
    uint64_t connection, sequence;
    std::shared_ptr<const Frame> frame;
    bool operator>(const Event& o) const { return at_us != o.at_us ? at_us > o.at_us : order > o.order; }
  };

  void Transmit(RegionId from, RegionId to, uint64_t sequence, const std::shared_ptr<const Frame>& frame);
  void Reconnect(RegionId from, RegionId to);
  void Push(Event e);

  void AddLink(RegionId from, RegionId to);

  Faults faults_;
  Random rng_;
  std::set<RegionId> regions_;
  uint64_t links_made_ = 0;
  std::map<std::pair<RegionId, RegionId>, Link> links_;
  std::set<RegionId> down_;
  std::priority_queue<Event, std::vector<Event>, std::greater<>> events_;
  int64_t now_us_ = 0;
  uint64_t order_ = 0;
  int64_t reconnects_ = 0, duplicates_ = 0;
};

}  // namespace aureole::sim
