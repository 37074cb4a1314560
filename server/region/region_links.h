// All links of one region: frames out, encoded once each, and frames in, through one mailbox for the tick thread.
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

  // `log` comes from gRPC threads. `keep`: this region makes checkpoints. `states`: where an earlier incarnation of it
  // left off, by peer.
  RegionLinks(const LinkIdentity& identity, const std::vector<RegionId>& peers,
              std::function<void(RegionId peer, const std::string& what)> log, bool keep = false,
              std::map<RegionId, LinkState> states = {});
  // Closes.
  ~RegionLinks();
  RegionLinks(const RegionLinks&) = delete;
  RegionLinks& operator=(const RegionLinks&) = delete;

  // Accepts the lower peers through `service`, which outlives the links, and dials the higher ones at
  // endpoints[region]. Once.
  void Connect(PeerService* service, const std::vector<std::string>& endpoints,
               const std::shared_ptr<grpc::ChannelCredentials>& credentials = grpc::InsecureChannelCredentials());

  // See PeerLink.
  void Redirect(RegionId peer, const std::string& endpoint, uint64_t incarnation);
  void SetDurable(const std::map<RegionId, uint64_t>& frames);
  std::map<RegionId, LinkState> States() const;
  // Of all links.
  bool caught_up() const;
  // Of this region and its peers, as far as they are met.
  Tick log_until() const;

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

  // Sums over the links.
  LinkStats Totals() const;

 private:
  const LinkIdentity identity_;
  std::vector<std::unique_ptr<PeerLink>> links_;  // ascending by peer
  PeerService* service_ = nullptr;

  std::mutex mutex_;
  std::condition_variable arrived_;
  std::vector<Frame> mailbox_;
  size_t awaited_ = 1;  // frames that Receive waits for: each wake-up of the tick thread costs
  bool interrupted_ = false;
};

}  // namespace aureole
