#include "server/region/frame_clock.h"

#include <algorithm>
#include <ctime>
#include <numeric>

namespace aureole {
namespace {

double Milliseconds(clockid_t clock) {
  timespec t;
  clock_gettime(clock, &t);
  return static_cast<double>(t.tv_sec) * 1e3 + static_cast<double>(t.tv_nsec) * 1e-6;
}

}  // namespace

FrameClock::FrameClock() { Lap(); }

FrameSample FrameClock::Lap() {
  const double process = Milliseconds(CLOCK_PROCESS_CPUTIME_ID);
  const double thread = Milliseconds(CLOCK_THREAD_CPUTIME_ID);
  const double wall = Milliseconds(CLOCK_MONOTONIC);
  const FrameSample sample{process - process_, thread - thread_, std::max(wall - wall_ - waited_, 0.0)};
  process_ = process;
  thread_ = thread;
  wall_ = wall;
  waited_ = 0;
  return sample;
}

v1::FrameTime Summarise(std::vector<double>* ms) {
  v1::FrameTime out;
  if (ms->empty()) return out;
  out.set_ticks(static_cast<int64_t>(ms->size()));
  out.set_mean_ms(std::accumulate(ms->begin(), ms->end(), 0.0) / static_cast<double>(ms->size()));
  const auto p99 = ms->end() - 1 - static_cast<std::ptrdiff_t>(ms->size() / 100);
  std::nth_element(ms->begin(), p99, ms->end());
  out.set_p99_ms(*p99);
  out.set_max_ms(*std::max_element(p99, ms->end()));
  return out;
}

void WindowMeter::Add(const FrameSample& sample) {
  process_.push_back(sample.process_cpu);
  thread_.push_back(sample.thread_cpu);
  wall_.push_back(sample.wall);
}

v1::Window WindowMeter::Take(Tick last) {
  v1::Window out;
  out.set_index(WindowOf(last));
  *out.mutable_process_cpu() = Summarise(&process_);
  *out.mutable_thread_cpu() = Summarise(&thread_);
  *out.mutable_wall() = Summarise(&wall_);
  process_.clear();
  thread_.clear();
  wall_.clear();
  return out;
}

}  // namespace aureole
