// What runs of a world measured, and how a split run compares with the undivided one. Pure functions.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "server/control/run.h"

namespace aureole {

// Frame times of one window of simulated time, as the paper's section 5 aggregates them (P88). "Frame time" is the CPU
// time of a server's process from tick start to tick start; "thread" that of the tick thread alone; "wall" the time of
// the tick outside of waits.
struct WindowMeasure {
  double t = 0;                                  // its end, s of simulated time
  double max_frame_ms = 0;                       // the largest of any server: the paper's measure
  double mean_frame_ms = 0;                      // over its ticks, of the server where this is largest
  double max_thread_ms = 0, mean_thread_ms = 0;  // likewise
  double max_wall_ms = 0;                        // likewise
  RegionId slowest = kNoRegion;                  // the server of max_frame_ms
  int64_t bodies = 0;                            // all servers, at the end of the window
};

struct RegionMeasure {
  RegionId region = kNoRegion;
  double last_max_frame_ms = 0;  // in the last window
  int64_t bodies = 0;            // at the end
  int64_t largest_cluster = 0;   // most bodies of one transfer it sent
  int64_t largest_component = 0, longest_chain = 0;
  double mean_frame_ms = 0, max_frame_ms = 0;  // over the whole run
  int64_t body_ticks = 0;                      // hosted
};

struct RunMeasure {
  std::vector<WindowMeasure> windows;  // a last one that the run filled less than half is left out
  std::vector<TickSum> hashes;         // ascending
  std::vector<RegionMeasure> regions;
  int64_t bodies = 0;
  int64_t violations = 0;
  int64_t transfers = 0, touching_transfers = 0, bodies_moved = 0, home_crossings = 0;
  int64_t largest_cluster = 0, largest_component = 0, longest_chain = 0;
  std::vector<int64_t> slack;  // v1::Report.slack, of all regions
  int64_t away_body_ticks = 0, body_ticks = 0;
  int64_t bytes_sent = 0, waits = 0, wait_us = 0;
  double wall_seconds = 0;

  double LastMaxFrameMs() const { return windows.empty() ? 0 : windows.back().max_frame_ms; }
  // Share of body-ticks that were hosted away from home.
  double AwayFromHome() const;
  // For each time that a body crossed a border of homes: transfers of clusters, and bodies moved in them; nothing when
  // none crossed.
  std::optional<double> TransfersPerHomeCrossing() const;
  std::optional<double> MovesPerHomeCrossing() const;
};

// Ticks from the arrival of a body that came to be with others to its first touch of one of them.
struct SlackQuantiles {
  int64_t met = 0, never = 0;  // bodies that did, and that did not within the ticks that are watched
  int min = 0, p1 = 0, p50 = 0, p99 = 0;
};
// Nothing when no body met another.
std::optional<SlackQuantiles> QuantilesOf(const std::vector<int64_t>& slack);

RunMeasure Measure(const RunResult& result, int64_t tick_us);

// The middle value, or the mean of the two in the middle. Precondition: not empty.
double MedianOf(std::vector<double> values);

// Of repeats of one run: times are medians; counts are the largest, as repeats of an exact run agree in them.
// Precondition: not empty.
RunMeasure MedianOf(std::span<const RunMeasure> repeats);

struct Comparison {
  bool hash_equal = false;    // at every tick of the undivided run, the last one of the run among them
  Tick first_difference = 0;  // 0: none
  int64_t ticks = 0;          // compared
  int64_t lost = 0;           // most bodies missing at one tick
  int64_t doubled = 0;        // most bodies too many at one tick
};

// Compares the sums of a split run with those of the undivided one; `last_tick` is where both ended.
Comparison Compare(const RunMeasure& split, const RunMeasure& undivided, Tick last_tick);

// Of repeats of one run: the first that differs speaks for all. Precondition: not empty.
Comparison CompareAll(std::span<const RunMeasure> repeats, const RunMeasure& undivided, Tick last_tick);

}  // namespace aureole
