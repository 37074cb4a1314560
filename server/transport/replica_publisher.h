// Frames for those who watch a region: made on a thread of its own from what the tick thread captures, encoded once for
// all who see the same and were told the same before, never queued.
#pragma once

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <tuple>
#include <utility>
#include <vector>

#include <grpcpp/support/slice.h>
#include <grpcpp/support/status.h>

#include "server/core/region.h"
#include "server/transport/cell_view.h"
#include "server/transport/replica_capture.h"
#include "server/transport/replica_scene.h"

namespace aureole {

// What one stream wants; validated.
struct ReplicaRequest {
  Tick period = 1;
  CellFormat format;
  CellView view;
  std::optional<std::vector<CellKey>> cells;  // of the view; nothing when they are too many to list
  DetailLevels detail;
  std::string key;  // equal requests have equal keys

  // A mistake is told to `check`.
  static ReplicaRequest Read(const Path& path, const v1::StreamReplicasRequest& request, int64_t tick_us,
                             SpecCheck* check);
};

// One who is sent frames. Thread-safe.
class ReplicaSubscriber {
 public:
  enum class State { kReady, kBusy, kGone };

  virtual ~ReplicaSubscriber() = default;
  // Whether it can take a frame now. Once gone, it is not asked again.
  virtual State Poll() = 0;
  // After kReady; a serialised ReplicaFrame, of this tick. False when it has become busy or gone meanwhile; then it has
  // not taken the frame.
  virtual bool Send(const grpc::Slice& frame, Tick tick) = 0;
  // What it wants now, if that has changed since the last call; the format must stay the same. First of all once.
  virtual std::shared_ptr<const ReplicaRequest> TakeRequest() = 0;
  // Ends its call.
  virtual void End(const grpc::Status& status) = 0;
};

class ReplicaPublisher {
 public:
  ReplicaPublisher();
  ~ReplicaPublisher();

  // What frames say of their server.
  void Serve(RegionId region, uint64_t layout_epoch, int64_t tick_us);
  // From here on frames are of this layout.
  void Follow(uint64_t layout_epoch) { layout_epoch_ = layout_epoch; }
  // Ends all calls, and those that join from here on. Returns at once.
  void Stop(const grpc::Status& status);
  // From any thread.
  void Join(std::shared_ptr<ReplicaSubscriber> subscriber);
  // Something may have changed: a request, or somebody is gone. From any thread; cheap.
  void Wake();
  // From the tick thread, after each tick; never waits. Cost: nothing unless a frame is due, else ReplicaCapture::Take.
  void AfterTick(Region* region);

  int64_t subscribers() const { return subscribers_; }
  // In frames, since the start.
  int64_t bytes_sent() const { return bytes_sent_; }
  // The tick of the last state that was published.
  Tick published() const { return published_; }

 private:
  using Clock = std::chrono::steady_clock;

  // What a frame showed, by cells; ascending.
  struct Shown {
    Tick tick = 0;
    std::vector<std::pair<CellKey, std::shared_ptr<const CellState>>> cells;
  };
  struct Frame {
    grpc::Slice bytes;
    std::shared_ptr<const Shown> shown;
  };
  struct Member {
    std::shared_ptr<ReplicaSubscriber> subscriber;
    std::shared_ptr<const Shown> base;  // of the frame before; null: none
  };
  // All who want the same.
  struct Audience {
    std::shared_ptr<const ReplicaRequest> request;
    std::vector<Member> members;
    std::shared_ptr<const Shown> last;  // made for it
    uint64_t watch = 0;                 // the first generation that holds its view; 0: not yet chosen
  };

  void Loop();
  void TakeRequests();
  void EndAll(const grpc::Status& status);
  void ChooseWatch();
  void Publish();
  std::shared_ptr<const Shown> Show(const Audience& audience);
  void ShowCells(const Audience& audience, const std::vector<CellKey>& cells, Shown* out);
  Frame MakeFrame(const Audience& audience, const Shown* base, const std::shared_ptr<const Shown>& shown);
  void AppendDescriptions(const std::vector<BodyId>& ids, std::string* out) const;
  void AddPassed(const Audience& audience, Tick since, const std::vector<BodyId>& left, v1::ReplicaFrame* out) const;
  const EncodedCell& Encoded(const CellState* base, const CellState* state, const CellFormat& format);
  float RealTimeFactor();

  RegionId region_ = kNoRegion;
  std::atomic<uint64_t> layout_epoch_ = 0;
  int64_t tick_us_ = 1;

  // Of the tick thread.
  ReplicaCapture capture_;
  std::atomic<int64_t> subscribers_ = 0;
  std::atomic<Tick> published_ = 0;
  std::atomic<int64_t> bytes_sent_ = 0;

  std::mutex mutex_;
  std::condition_variable changed_;
  bool ended_ = false, woken_ = false;
  std::optional<grpc::Status> stopped_;
  std::shared_ptr<const Watch> watch_;  // null: nobody watches
  std::vector<std::shared_ptr<ReplicaSubscriber>> joining_;
  std::unique_ptr<Capture> full_, empty_;  // handed to the publisher's thread, and back
  std::atomic<bool> watched_ = false;      // watch_ != nullptr, for the tick thread

  // Of the publisher's thread.
  ReplicaScene scene_;
  std::map<std::string, Audience> audiences_;
  std::map<std::tuple<const CellState*, const CellState*, CellFormat>, EncodedCell> encoded_;  // of this tick
  std::deque<std::pair<Clock::time_point, Tick>> pace_;
  uint64_t generation_ = 0;  // of watches

  std::thread thread_;
};

}  // namespace aureole
