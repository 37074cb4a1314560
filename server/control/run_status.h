// What the control plane knows of a running world. Plain values, copied out of ControlService.
#pragma once

#include <chrono>
#include <cstdint>
#include <deque>
#include <optional>
#include <string>
#include <vector>

#include "aureole/v1/control.pb.h"
#include "server/core/types.h"

namespace aureole {

enum class Stage : uint8_t {
  kJoining,   // not all servers have said Hello
  kLoading,   // not all servers are Ready
  kReady,     // all are
  kRunning,   // Start was sent
  kFinished,  // every server has reported its last tick
};

struct RegionStatus {
  uint64_t incarnation = 1;  // of the server that is expected, or here
  bool joined = false, ready = false, finished = false;
  bool was_ready = false;          // this server or an earlier one: there is a checkpoint
  uint64_t ready_incarnation = 0;  // the newest that was
  int keeper = 0;                  // as in Report, when it last said one
  bool left = false;               // its stream has ended
  bool member = true;   // by the layout in force, as far as is known; else it will join, or leaves, or has left
  std::string goodbye;  // the reason it gave, if any
  bool gone = false;    // it said with it that the region has left
  // It was told to end, and does so then if its region has not left before; whether it waits for an answer.
  std::optional<std::chrono::steady_clock::time_point> leaves_by;
  bool asks_to_leave = false;
  std::string fetched;  // why and where from this server's checkpoint was fetched; empty: it was not
  std::string endpoint, metrics_endpoint;
  int64_t pid = 0;
  // The newest report, without its hashes, windows and violations. Before the first one: `bodies` of its Ready.
  v1::Report report;
  v1::FrameTime frame;          // over the last second or so: mean of the means, largest p99 and maximum
  double bytes_per_second = 0;  // frame payload sent, between the last two reports
  std::chrono::steady_clock::time_point reported;  // when the newest report came, or the start
};

// One tick of the whole world: sums over the regions.
struct TickSum {
  Tick tick = 0;
  uint64_t hash = 0;
  int64_t bodies = 0;
  int regions = 0;  // that have reported this tick
  int members = 0;  // that will

  bool complete() const { return regions > 0 && regions == members; }
};

struct RunStatus {
  Stage stage = Stage::kJoining;
  std::string control;                // where servers and operators reach the control plane, host:port
  int64_t start_unix_us = 0;          // wall time of tick 0; 0: not known yet
  std::vector<RegionStatus> regions;  // the list only grows
  TickSum hash;  // the newest that every region has told its part of; of no regions when there is none

  // Of the members.
  Tick MinTick() const;
  Tick MaxTick() const;
  int64_t Bodies() const;
  int64_t Awake() const;
  // One clause for each thing that the run waits for, empty when it flows: "region 2 waits for region 1",
  // "nothing heard of region 1 for 2.3 s", "region 0 has not joined".
  std::vector<std::string> Waiting() const;
};

// Merges reports of consecutive intervals: tick-weighted mean, largest p99 and maximum.
v1::FrameTime Merge(const std::deque<v1::FrameTime>& parts);

}  // namespace aureole
