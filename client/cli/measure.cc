#include "client/cli/measure.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>

namespace aureole {
namespace {

constexpr double kWindowSeconds = 5;  // the paper's

// Sums over servers a window at a time; `ticks` is that of the server that stepped most in it.
struct WindowSum {
  WindowMeasure measure;
  int64_t ticks = 0;
};

void Add(const v1::Window& w, RegionId region, WindowSum* sum) {
  WindowMeasure& m = sum->measure;
  m.t = kWindowSeconds * static_cast<double>(w.index() + 1);
  if (m.slowest == kNoRegion || w.process_cpu().max_ms() > m.max_frame_ms) m.slowest = region;
  m.max_frame_ms = std::max(m.max_frame_ms, w.process_cpu().max_ms());
  m.mean_frame_ms = std::max(m.mean_frame_ms, w.process_cpu().mean_ms());
  m.max_thread_ms = std::max(m.max_thread_ms, w.thread_cpu().max_ms());
  m.mean_thread_ms = std::max(m.mean_thread_ms, w.thread_cpu().mean_ms());
  m.max_wall_ms = std::max(m.max_wall_ms, w.wall().max_ms());
  m.bodies += w.bodies();
  sum->ticks = std::max(sum->ticks, w.process_cpu().ticks());
}

// Of the whole run.
void AddFrames(const std::vector<v1::Window>& windows, RegionMeasure* region) {
  int64_t ticks = 0;
  double sum_ms = 0;
  for (const v1::Window& w : windows) {
    ticks += w.process_cpu().ticks();
    sum_ms += w.process_cpu().mean_ms() * static_cast<double>(w.process_cpu().ticks());
    region->max_frame_ms = std::max(region->max_frame_ms, w.process_cpu().max_ms());
  }
  if (ticks > 0) region->mean_frame_ms = sum_ms / static_cast<double>(ticks);
}

}  // namespace

double RunMeasure::AwayFromHome() const {
  return body_ticks > 0 ? static_cast<double>(away_body_ticks) / static_cast<double>(body_ticks) : 0;
}

std::optional<double> RunMeasure::TransfersPerHomeCrossing() const {
  if (home_crossings == 0) return std::nullopt;
  return static_cast<double>(transfers) / static_cast<double>(home_crossings);
}

std::optional<double> RunMeasure::MovesPerHomeCrossing() const {
  if (home_crossings == 0) return std::nullopt;
  return static_cast<double>(bodies_moved) / static_cast<double>(home_crossings);
}

std::optional<SlackQuantiles> QuantilesOf(const std::vector<int64_t>& slack) {
  if (slack.empty()) return std::nullopt;
  SlackQuantiles out;
  out.never = slack.back();
  out.met = std::accumulate(slack.begin(), slack.end() - 1, int64_t{0});
  if (out.met == 0) return std::nullopt;
  // The smallest slack that at least this share of the bodies did not exceed.
  const auto quantile = [&](double share) {
    const auto rank = std::max<int64_t>(1, static_cast<int64_t>(std::ceil(share * static_cast<double>(out.met))));
    int64_t sum = 0;
    for (size_t i = 0;; ++i) {
      if ((sum += slack[i]) >= rank) return static_cast<int>(i);
    }
  };
  out.min = quantile(0);
  out.p1 = quantile(0.01);
  out.p50 = quantile(0.5);
  out.p99 = quantile(0.99);
  return out;
}

RunMeasure Measure(const RunResult& result, int64_t tick_us) {
  RunMeasure out;
  out.hashes = result.hashes;
  out.wall_seconds = result.wall_seconds;

  std::map<int64_t, WindowSum> windows;
  for (size_t r = 0; r < result.windows.size(); ++r) {
    for (const v1::Window& w : result.windows[r]) Add(w, static_cast<RegionId>(r), &windows[w.index()]);
  }
  const double full_ticks = kWindowSeconds * 1e6 / static_cast<double>(tick_us);
  if (windows.size() > 1 && static_cast<double>(windows.rbegin()->second.ticks) < full_ticks / 2) {
    windows.erase(std::prev(windows.end()));
  }
  for (const auto& [index, sum] : windows) out.windows.push_back(sum.measure);
  const int64_t last_window = windows.empty() ? -1 : windows.rbegin()->first;

  for (size_t r = 0; r < result.status.regions.size(); ++r) {
    const v1::Report& report = result.status.regions[r].report;
    RegionMeasure region;
    region.region = static_cast<RegionId>(r);
    region.bodies = report.bodies();
    region.largest_cluster = report.largest_cluster();
    region.largest_component = report.largest_component();
    region.longest_chain = report.longest_chain();
    if (r < result.windows.size()) {
      for (const v1::Window& w : result.windows[r]) {
        if (w.index() == last_window) region.last_max_frame_ms = w.process_cpu().max_ms();
      }
      AddFrames(result.windows[r], &region);
    }
    region.body_ticks = report.body_ticks();
    out.regions.push_back(region);
    out.bodies += report.bodies();
    out.violations += report.violations();
    out.transfers += report.transfers();
    out.touching_transfers += report.touching_transfers();
    out.bodies_moved += report.bodies_moved();
    out.home_crossings += report.home_crossings();
    out.largest_cluster = std::max(out.largest_cluster, report.largest_cluster());
    out.largest_component = std::max(out.largest_component, report.largest_component());
    out.longest_chain = std::max(out.longest_chain, report.longest_chain());
    out.slack.resize(std::max<size_t>(out.slack.size(), report.slack_size()));
    for (int i = 0; i < report.slack_size(); ++i) out.slack[i] += report.slack(i);
    out.away_body_ticks += report.away_body_ticks();
    out.body_ticks += report.body_ticks();
    out.bytes_sent += report.bytes_sent();
    out.waits += report.waits();
    out.wait_us += report.wait_us();
  }
  return out;
}

double MedianOf(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  const size_t half = values.size() / 2;
  return values.size() % 2 == 1 ? values[half] : (values[half - 1] + values[half]) / 2;
}

RunMeasure MedianOf(std::span<const RunMeasure> repeats) {
  RunMeasure out = repeats.front();
  for (const RunMeasure& m : repeats) {
    out.windows.resize(std::min(out.windows.size(), m.windows.size()));
    out.regions.resize(std::min(out.regions.size(), m.regions.size()));
    out.violations = std::max(out.violations, m.violations);
  }
  const auto median = [&](auto value) {
    std::vector<double> values;
    for (const RunMeasure& m : repeats) values.push_back(value(m));
    return MedianOf(std::move(values));
  };
  for (size_t i = 0; i < out.windows.size(); ++i) {
    for (double WindowMeasure::*field :
         {&WindowMeasure::max_frame_ms, &WindowMeasure::mean_frame_ms, &WindowMeasure::max_thread_ms,
          &WindowMeasure::mean_thread_ms, &WindowMeasure::max_wall_ms}) {
      out.windows[i].*field = median([&](const RunMeasure& m) { return m.windows[i].*field; });
    }
  }
  for (size_t r = 0; r < out.regions.size(); ++r) {
    for (double RegionMeasure::*field :
         {&RegionMeasure::last_max_frame_ms, &RegionMeasure::mean_frame_ms, &RegionMeasure::max_frame_ms}) {
      out.regions[r].*field = median([&](const RunMeasure& m) { return m.regions[r].*field; });
    }
  }
  out.wall_seconds = median([](const RunMeasure& m) { return m.wall_seconds; });
  return out;
}

Comparison Compare(const RunMeasure& split, const RunMeasure& undivided, Tick last_tick) {
  Comparison out;
  std::map<Tick, TickSum> have;
  for (const TickSum& sum : split.hashes) {
    if (sum.complete()) have[sum.tick] = sum;
  }
  bool at_end = false;
  out.hash_equal = true;
  for (const TickSum& want : undivided.hashes) {
    const auto found = have.find(want.tick);
    const bool equal = found != have.end() && found->second.hash == want.hash;
    if (found != have.end()) {
      ++out.ticks;
      out.lost = std::max(out.lost, want.bodies - found->second.bodies);
      out.doubled = std::max(out.doubled, found->second.bodies - want.bodies);
    }
    if (!equal && out.hash_equal) {
      out.hash_equal = false;
      out.first_difference = want.tick;
    }
    at_end |= want.tick == last_tick;
  }
  if (!at_end) out.hash_equal = false;
  return out;
}

Comparison CompareAll(std::span<const RunMeasure> repeats, const RunMeasure& undivided, Tick last_tick) {
  Comparison worst = Compare(repeats.front(), undivided, last_tick);
  for (const RunMeasure& run : repeats.subspan(1)) {
    const Comparison c = Compare(run, undivided, last_tick);
    const int64_t lost = std::max(worst.lost, c.lost), doubled = std::max(worst.doubled, c.doubled);
    if (worst.hash_equal && !c.hash_equal) worst = c;
    worst.lost = lost;
    worst.doubled = doubled;
  }
  return worst;
}

}  // namespace aureole
