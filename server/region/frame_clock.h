// What a tick costs, by three clocks, and the windows of the paper's section 5.
#pragma once

#include <cstdint>
#include <vector>

#include "aureole/v1/control.pb.h"
#include "server/core/types.h"

namespace aureole {

// Milliseconds from the start of a tick to the start of the next.
struct FrameSample {
  double process_cpu = 0;  // of all threads of the process: "frame time"
  double thread_cpu = 0;   // of the calling thread
  double wall = 0;         // without the waits
};

// Measures laps on the thread that calls it.
class FrameClock {
 public:
  FrameClock();
  // Wall time that the thread slept or waited for peers; not part of the tick's wall time.
  void AddWait(double ms) { waited_ += ms; }
  // The lap since construction or the last call; the next one begins.
  FrameSample Lap();

 private:
  double process_ = 0, thread_ = 0, wall_ = 0, waited_ = 0;
};

// Mean, 99th percentile and maximum; reorders `ms`. All 0 for none. The percentile is the smallest sample that is not
// exceeded by more than 1 % of them.
v1::FrameTime Summarise(std::vector<double>* ms);

// Gathers samples into windows of 5 s of simulated time. Tick n simulates [n-1, n) tick lengths and belongs to the
// window that holds its beginning.
class WindowMeter {
 public:
  static constexpr int64_t kWindowUs = 5'000'000;

  explicit WindowMeter(int64_t tick_us) : tick_us_(tick_us) {}

  int64_t WindowOf(Tick n) const { return (n - 1) * tick_us_ / kWindowUs; }
  // Whether tick n+1 belongs to another window than n.
  bool EndsAt(Tick n) const { return WindowOf(n + 1) != WindowOf(n); }
  void Add(const FrameSample& sample);
  bool empty() const { return process_.empty(); }
  // The window of tick `last`, with the samples since the last call; without the counts of bodies.
  v1::Window Take(Tick last);

 private:
  const int64_t tick_us_;
  std::vector<double> process_, thread_, wall_;
};

}  // namespace aureole
