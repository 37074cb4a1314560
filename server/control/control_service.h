// The control plane's side of a run (control.proto): servers join, get their assignments, start together, report.
#pragma once

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include <absl/status/status.h>

#include "aureole/v1/control.grpc.pb.h"
#include "server/control/run_status.h"
#include "server/core/division.h"

namespace aureole {

inline constexpr uint32_t kControlProtocolVersion = 1;

// What the servers of one run are told.
struct RunPlan {
  // What is known of a region before anything is heard of it.
  struct Region {
    std::string token;               // what its server says; empty: none is expected yet
    uint64_t incarnation = 1;        // of that server
    bool was_ready = false;          // some server of it was: there is a checkpoint
    uint64_t ready_incarnation = 0;  // the newest that was
    int keeper = 0;                  // as in Report
    std::string endpoint = {};
    std::optional<v1::LayoutChange> joins = std::nullopt;  // with which it joins, or has joined
    bool member = true;
    bool retired = false;  // it has left: it has no server
  };
  v1::WorldSpec world;
  std::vector<Region> regions;
  uint64_t control_epoch = 1;  // grows with each control plane that takes over
  uint64_t layout_epoch = kFirstLayoutEpoch;
  int64_t start_unix_us = 0;  // of a world that an earlier control plane has started
  bool undivided = false;     // one region, whatever the layout says
  bool no_real_time = false;
  Tick checkpoint_every = 0;  // ticks; 0: none, and no region can be replaced
  Tick last_tick = 0;         // 0: no end
  Tick hash_every = 0;        // ticks; 0: never
};

// Serves one run. Thread-safe; no call blocks, except Wait. Shut the gRPC server down before this goes.
class ControlService final : public v1::Control::CallbackService {
 public:
  explicit ControlService(RunPlan plan);
  ~ControlService() override;

  grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion>* Join(grpc::CallbackServerContext* context) override;

  RunStatus Status() const;
  // Ascending by tick. Only the newest 2^20 are kept.
  std::vector<TickSum> Hashes() const;
  // Of one region, in order. Only the newest 4096 are kept.
  std::vector<v1::Window> Windows(RegionId region) const;
  // The first 64.
  std::vector<v1::Violation> Violations() const;
  // Returns when something other than a plain report has happened since the last call, or after `longest`.
  void Wait(std::chrono::milliseconds longest);
  // The region's next server has this incarnation and token. An older one that is still here must leave. Any time.
  void Expect(RegionId region, uint64_t incarnation, const std::string& token);
  // Tells all servers to begin with tick 0 at this time, at Stage::kReady; else it does nothing.
  void StartAll(int64_t start_unix_us);
  // The region joins with this layout: its servers are told so, and all members of them. The list of regions grows when
  // it is new; else the name is free.
  void Admit(RegionId region, const LayoutChange& layout);
  // It will not join after all: its server is told to end.
  void Dismiss(RegionId region, const std::string& reason);
  // Its server has ended for good, and all others are told.
  void Retire(RegionId region);
  // Tells the server of this region, if there is one, to offer the change to the world.
  void ChangeLayout(RegionId to, uint64_t sequence, const LayoutChange& layout);
  // Tells the server of this region, if there is one, to make a checkpoint.
  void SaveCheckpoint(RegionId region, Tick tick);
  // What became of a change, as the newest answer to ChangeLayout says, once.
  std::optional<v1::LayoutOutcome> TakeLayoutOutcome();
  // Answers the region's server that was told to end: it leaves, or why it cannot.
  void AnswerLeaving(RegionId region, const std::string& refused);
  // This layout is in force.
  void SetLayout(const LayoutChange& layout);
  // Tells every server that is here to end.
  void Stop(const std::string& reason);
  // Ends all streams: the servers go on, and join again where they find a control plane. No new stream may come.
  void Close();

 private:
  class Session;
  struct RegionRecord {
    RegionStatus status;
    Session* session = nullptr;
    std::string token;
    bool assigned = false;                  // the server that is here
    bool retired = false;                   // there is none, and will be none
    std::optional<v1::LayoutChange> joins;  // with which it joins, or has joined
    std::deque<v1::FrameTime> recent;
    std::deque<v1::Window> windows;
    Tick last_hash = -1;  // reported
  };

  // Handles one message of a session; an error ends the session and changes nothing else.
  absl::Status Handle(Session* session, const v1::FromRegion& message);
  absl::Status HandleHello(Session* session, const v1::Hello& hello);
  absl::Status HandleRunning(const RegionRecord& record, const v1::Running& running) const;
  void Resume(RegionId region, const v1::Running& running);
  absl::Status HandleReady(RegionId region, const v1::Ready& ready);
  absl::Status HandleReport(RegionRecord* record, const v1::Report& report);
  void Leave(Session* session);
  void AssignAll();
  void Assign(RegionId region);
  void Start(RegionRecord* record);
  v1::ToRegion Moved(RegionId region) const;
  void TellMoved(RegionId region);
  void CheckReady();
  void CheckFinished();
  void Changed();

  const RunPlan plan_;
  const uint64_t world_hash_;
  mutable std::mutex mutex_;  // guards everything below, and the sessions' own fields
  std::condition_variable changed_;
  uint64_t changes_ = 0, seen_ = 0;
  std::set<Session*> sessions_;  // alive
  Stage stage_ = Stage::kJoining;
  int64_t start_unix_us_ = 0;  // once running
  uint64_t layout_epoch_;
  std::optional<v1::LayoutOutcome> layout_outcome_;
  std::vector<RegionRecord> regions_;
  std::map<Tick, TickSum> hashes_;
  std::vector<v1::Violation> violations_;
};

}  // namespace aureole
