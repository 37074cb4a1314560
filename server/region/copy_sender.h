// A region's end of its copy: ships checkpoints and the log of inputs to the keeper, another region's server, as the
// region makes them (proto/aureole/v1/copy.proto).
//
// The keeper *covers* the region once a checkpoint is durable there, and with it all inputs since. Only then anything
// depends on it. When it is away, or slower than its bounds, the region goes on with its own volume; the next
// checkpoint after it is there again is shipped whole, with the inputs from there on. What the copy lacks until then is
// known as a tick: least_tick.
#pragma once

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <functional>
#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <grpcpp/client_context.h>
#include <grpcpp/security/credentials.h>

#include "aureole/v1/copy.grpc.pb.h"
#include "server/core/types.h"

namespace aureole {

// The next member in their order, the first one after the last; kNoRegion: there is no other.
RegionId KeeperOf(RegionId region, const std::vector<RegionId>& members);

// Whose copy it is.
struct CopyIdentity {
  uint64_t world_hash = 0;
  RegionId region = kNoRegion;
  uint64_t incarnation = 1;
};
v1::CopyOf CopyOfMessage(const CopyIdentity& identity, RegionId keeper);

class CopySender {
 public:
  // A keeper that needs longer for inputs is not waited for, nor one that needs longer for a checkpoint than the region
  // for two more: what covers it is never older than the newest checkpoint but two.
  static constexpr std::chrono::milliseconds kLongestLog{100};
  // Bytes of inputs that wait to be shipped.
  static constexpr size_t kMostWaiting = 16 << 20;

  struct Stats {
    RegionId keeper = kNoRegion;
    Tick tick = 0;         // of the newest checkpoint that is durable there; 0: none of this server's
    Tick shipping = 0;     // the one that is under way; 0: none
    bool covers = false;   // all that is needed is there
    int64_t failures = 0;  // times that it ceased to
    std::string failure;   // why it does not; empty: it does, or has only begun to
    bool alone = false;    // inputs that were told are not known to be there
    Tick least_tick = 0;   // an older checkpoint there must not be gone on from
  };

  // `least`: an older checkpoint at the keeper must not be gone on from, whatever else is there; 0: the region begins
  // with its world. `log` comes from a thread of the sender.
  CopySender(const CopyIdentity& identity, Tick least, std::function<void(const std::string&)> log);
  // Ends the connection.
  ~CopySender();
  CopySender(const CopySender&) = delete;
  CopySender& operator=(const CopySender&) = delete;

  // Connects to the keeper, and stays connected; by region, `endpoints` says where. Once.
  void Connect(RegionId keeper, std::vector<std::string> endpoints,
               std::shared_ptr<grpc::ChannelCredentials> credentials);
  // The region's server is this incarnation, there. Any thread.
  void Redirect(RegionId region, const std::string& endpoint, uint64_t incarnation);

  // The tick thread; none of these waits for the network.

  // A checkpoint of this tick is about to be shipped. `keeper`: who has it from here on.
  void Begin(Tick tick, RegionId keeper);
  // `records`, as EncodeInputs has them, of inputs that will be offered in this tick. Ticks ascend.
  void Log(Tick tick, const std::string& records);
  // Checkpoints up to `newest` are durable here. Up to which are the frames that they have used not needed any more?
  // From here on the region relies on the answer.
  Tick MostToForget(Tick newest);

  // The tick thread. Waits until all that was logged is durable at the keeper, at most kLongestLog from when it was,
  // and not at all when it does not cover the region. The caller may tell it then, in every case.
  void AwaitLogged();
  // Any thread; the checkpoint of Begin.
  void Ship(Tick tick, std::shared_ptr<const std::string> checkpoint);
  // The keeper has heard of a later incarnation: this one must not say anything any more.
  bool fenced() const;
  Stats stats() const;

 private:
  using Clock = std::chrono::steady_clock;
  using Stream = grpc::ClientReaderWriter<v1::KeepMessage, v1::Kept>;

  struct Batch {
    Tick tick = 0;
    std::shared_ptr<const std::string> records;
  };

  bool CanDial() const;
  void Run();
  bool Converse(std::unique_lock<std::mutex>* lock);
  void WriteParts(std::unique_lock<std::mutex>* lock, Stream* stream);
  void NextPart(v1::CopyPart* part);
  void ReadAll(Stream* stream);
  void Heard(const v1::Kept& kept);
  void Lose(const std::string& why);

  const CopyIdentity identity_;
  const bool begins_;
  const std::function<void(const std::string&)> log_;
  std::shared_ptr<grpc::ChannelCredentials> credentials_;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  bool stopped_ = false, fenced_ = false;
  RegionId keeper_ = kNoRegion;
  std::vector<std::string> endpoints_;  // by region
  std::vector<uint64_t> incarnations_;  // by region; 0: not known
  uint64_t dials_ = 0;                  // grows when it should be dialled at once
  Clock::time_point connecting_since_;

  // Of the present connection.
  grpc::ClientContext* context_ = nullptr;
  bool open_ = false;       // the keeper has answered
  bool lost_ = false;       // it must end
  bool ended_ = false;      // the keeper has ended it
  bool streaming_ = false;  // from a checkpoint on, everything is shipped
  bool covers_ = false, covered_ = false;
  Tick shipping_ = 0;                              // the checkpoint; 0: none
  int passed_over_ = 0;                            // checkpoints that were made since it was begun
  std::shared_ptr<const std::string> checkpoint_;  // null: not there yet, or written
  size_t checkpoint_written_ = 0;
  std::deque<Batch> batches_;  // not yet written
  size_t waiting_bytes_ = 0, batch_written_ = 0;
  Tick copied_ = 0, copied_inputs_ = 0;  // durable there

  Batch newest_;  // that was logged
  Clock::time_point logged_at_;
  Tick alone_ = 0;            // the last inputs that were told and are not known to be durable there
  Tick forgot_ = 0;           // peers may have forgotten frames that older checkpoints need
  bool has_covered_ = false;  // some connection
  bool refused_ = false;      // the last one, and not because the keeper is not there yet
  int64_t failures_ = 0;
  std::string why_lost_;
  std::string last_logged_;

  std::thread thread_;  // dials and writes
};

}  // namespace aureole
