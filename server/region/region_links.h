// All links of one region: frames out, encoded once each, and frames in, through one mailbox for the tick thread.
//
// A link is made when a region becomes a peer, or is about to, and it outlives the peers' common time: a region that
// has left, or one that it has left behind, may die and need frames again. So a link goes only when somebody who knows
// says so (Forget).
#pragma once

#include <chrono>
#include <condition_variable>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "server/core/frame.h"
#include "server/transport/peer_link.h"
#include "server/transport/peer_service.h"

namespace aureole {

class RegionLinks {
 public:
  using Clock = std::chrono::steady_clock;

  // Links to the peers, and to whom `states` name: where an earlier incarnation of this region left off. The identity's
  // layout epoch is that of links without a state. `log` comes from gRPC threads. `keep`: this region makes
  // checkpoints.
  RegionLinks(const LinkIdentity& identity, const std::vector<RegionId>& peers,
              std::function<void(RegionId peer, const std::string& what)> log, bool keep = false,
              std::map<RegionId, LinkState> states = {});
  // Closes.
  ~RegionLinks();
  RegionLinks(const RegionLinks&) = delete;
  RegionLinks& operator=(const RegionLinks&) = delete;

  // Accepts the lower peers through `service`, which outlives the links, and dials the higher ones at
  // endpoints[region], as soon as that is known: not empty. Once.
  void Connect(PeerService* service, const std::vector<std::string>& endpoints,
               const std::shared_ptr<grpc::ChannelCredentials>& credentials = grpc::InsecureChannelCredentials());

  // Any thread. See PeerLink; what is told of a region that is no peer yet counts when it is one.
  void Redirect(RegionId peer, const std::string& endpoint, uint64_t incarnation);
  // Any thread. The region becomes a peer with the layout of this epoch: its link is made at once. Ignored when it has
  // one of that epoch, or a newer one.
  void Expect(RegionId peer, uint64_t epoch);
  // Any thread. The region has left and its process has ended, or it will not join after all: its link goes. Ignored
  // while it is a peer. Waits for the callbacks of gRPC.
  void Forget(RegionId peer);
  // What the layout of this epoch says, which is in force, and what the pending one will say: the same when there is
  // none. Peers that are in neither are parted from, those that come with the pending one have a link from here on.
  void Follow(uint64_t epoch, const std::vector<RegionId>& members, const std::vector<RegionId>& next_members);
  // This region is no member any more: it parts from all.
  void Part();
  // Nobody needs a frame again that was sent here.
  bool released() const;

  // See PeerLink; of links of the same epoch.
  void SetDurable(const std::map<RegionId, LinkMark>& frames);
  std::map<RegionId, LinkState> States() const;
  // Of all links to peers.
  bool caught_up() const;
  // Of this region and its peers, as far as they are met.
  Tick log_until() const;
  // Peers that this region has never spoken with, ascending, appended.
  void Unmet(std::vector<RegionId>* out) const;

  // Any thread. Where the others are, by region, as far as was told; this region's place is empty.
  std::vector<std::string> Endpoints() const;

  // Queues the frames; never waits for the network.
  void Send(const std::vector<Frame>& frames);
  // Moves what has arrived to `out`; when that is less than `at_least` frames, waits until it is as much, `deadline`,
  // or Interrupt. Frames of one peer come in its order.
  void Receive(size_t at_least, Clock::time_point deadline, std::vector<Frame>* out);
  // Ends a waiting Receive, and every later one at once.
  void Interrupt();

  // Ends the present connection to this peer, or to all, as a fault of the network would (the links resume).
  void Cut(RegionId peer);
  void CutAll();
  // Waits until everything was written, `at_most` in all; false when that took longer.
  bool Drain(std::chrono::milliseconds at_most);
  void Close();

  // Sums over the links, those that are gone included.
  LinkStats Totals() const;

 private:
  struct Peer {
    std::unique_ptr<PeerLink> link;
    bool dialled = false;
    bool member = true;  // of the layout in force, or of the pending one
  };
  struct Address {
    std::string endpoint;
    uint64_t incarnation = 0;
  };

  void Make(RegionId peer, uint64_t epoch, LinkState state = {});
  void Attach(Peer* peer);
  std::unique_ptr<PeerLink> Take(std::map<RegionId, Peer>::iterator peer);

  const LinkIdentity identity_;
  const bool keep_;
  const std::function<void(RegionId peer, const std::string& what)> log_;

  mutable std::mutex links_mutex_;  // before any link's own, and before the mailbox's
  std::map<RegionId, Peer> links_;
  std::map<RegionId, Address> addresses_;
  PeerService* service_ = nullptr;  // once connected
  std::shared_ptr<grpc::ChannelCredentials> credentials_;
  LinkStats gone_;  // of links that were forgotten

  std::mutex mutex_;
  std::condition_variable arrived_;
  std::vector<Frame> mailbox_;
  size_t awaited_ = 1;  // frames that Receive waits for: each wake-up of the tick thread costs
  bool interrupted_ = false;
};

}  // namespace aureole
