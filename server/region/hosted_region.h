// One assignment being served: the world, the region, its links and its tick thread.
#pragma once

#include <chrono>
#include <filesystem>
#include <memory>
#include <string>
#include <thread>

#include <absl/status/statusor.h>

#include "aureole/v1/control.pb.h"
#include "server/core/region.h"
#include "server/core/world.h"
#include "server/region/copy_sender.h"
#include "server/region/journal.h"
#include "server/region/region_links.h"
#include "server/region/tick_loop.h"

namespace aureole {

class HostedRegion {
 public:
  // Loads the world and the region's share of it, or, when the assignment says `recover`, what the journal has of it,
  // or else the region's keeper, which `credentials` are for; one that is to join a world that runs, and has not done
  // so yet, is empty. `data`: directory for the journal; needed when the assignment asks for checkpoints.
  // InvalidArgument when the assignment makes no sense, else the journal's errors, or DataLoss with those of the
  // keeper. Waits for the keeper, at most kLongestFetch.
  static absl::StatusOr<std::unique_ptr<HostedRegion>> Load(
      const v1::Assignment& assignment, const std::filesystem::path& data,
      const std::shared_ptr<grpc::ChannelCredentials>& credentials);
  static constexpr std::chrono::seconds kLongestFetch{8};
  // Stops and joins the tick thread, and closes the links.
  ~HostedRegion();

  const World& world() const { return world_; }
  const Region& region() const { return *region_; }
  RegionLinks& links() { return *links_; }
  const v1::Assignment& assignment() const { return assignment_; }
  // Why and where from the checkpoint was fetched; empty: it was not.
  const std::string& fetched() const { return fetched_; }

  // Accepts and dials the peers.
  void Connect(PeerService* service, const std::shared_ptr<grpc::ChannelCredentials>& credentials);
  // Starts the tick thread. Once.
  void Start(int64_t start_unix_us, TickLoop::Hooks hooks);
  struct Progress {
    Tick tick = 0;  // last stepped
    int64_t bodies = 0;
  };
  // As of the newest report. Any thread.
  Progress progress() const;
  // The next report says again what may not have been heard. Any thread.
  void SayAgain();
  // The peer's next incarnation is there; or a region is that will be a peer.
  void PeerMoved(const v1::PeerMoved& moved);
  void PeerLeft(const v1::PeerLeft& left);
  // Offers the change to the world, once the tick thread runs. InvalidArgument when it is none.
  absl::Status ChangeLayout(const v1::ChangeLayout& change);
  // Makes a checkpoint after tick n, or soon after it; nothing without a journal, or before Start.
  void SaveAt(Tick n);
  // Ends the tick thread. Idempotent.
  void Stop();

 private:
  HostedRegion(const v1::Assignment& assignment, World world);
  using Credentials = std::shared_ptr<grpc::ChannelCredentials>;

  absl::Status LoadRegion(const std::filesystem::path& data, const Credentials& credentials);
  absl::Status Recover(const Credentials& credentials);
  absl::StatusOr<Journal::Recovered> Find(const Credentials& credentials);
  absl::Status MakeRegion();

  const v1::Assignment assignment_;
  const World world_;
  std::unique_ptr<CopySender> copy_;  // null: no checkpoints
  std::unique_ptr<Journal> journal_;  // as well
  bool recovered_ = false;            // from a checkpoint
  std::string fetched_;
  std::map<RegionId, LinkState> link_states_;
  std::vector<LoggedInput> replay_;
  std::vector<Checkpoint::Hash> hashes_;
  std::unique_ptr<Region> region_;
  std::unique_ptr<RegionLinks> links_;
  std::unique_ptr<TickLoop> loop_;
  std::thread thread_;
};

}  // namespace aureole
