#include "client/cli/policies_report.h"

#include <algorithm>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <nlohmann/json.hpp>

#include "client/cli/slack_json.h"
namespace aureole {
namespace {

using Json = nlohmann::ordered_json;

const RegionMeasure* Busiest(const RunMeasure& m) {
  const auto it = std::max_element(m.regions.begin(), m.regions.end(),
                                   [](const auto& a, const auto& b) { return a.mean_frame_ms < b.mean_frame_ms; });
  return it == m.regions.end() ? nullptr : &*it;
}

double MeanMs(const RunMeasure& m) {
  const RegionMeasure* busiest = Busiest(m);
  return busiest ? busiest->mean_frame_ms : 0;
}

double MaxMs(const RunMeasure& m) {
  const RegionMeasure* busiest = Busiest(m);
  return busiest ? busiest->max_frame_ms : 0;
}

bool AwayMet(const PolicyFigures& f, const PolicyBar& bar) { return f.away <= bar.away; }
bool MovesMet(const PolicyFigures& f, const PolicyBar& bar) { return f.moves.value_or(0) <= bar.moves; }

std::string SceneName(const PolicyScene& scene) {
  return absl::StrFormat("%g bodies/m2, %s", scene.density, scene.fast ? "fast" : "slow");
}

std::string OrDash(const std::optional<double>& value, int digits) {
  return value ? absl::StrFormat("%.*f", digits, *value) : "-";
}

std::string BarText(const PolicyFigures& f, const std::optional<PolicyBar>& bar) {
  if (!bar) return "";
  return absl::StrFormat("away <= %g %s, moves <= %g %s", bar->away, AwayMet(f, *bar) ? "PASS" : "miss", bar->moves,
                         MovesMet(f, *bar) ? "PASS" : "miss");
}

std::string SlackText(const RunMeasure& m) {
  const std::optional<SlackQuantiles> q = QuantilesOf(m.slack);
  return q ? absl::StrCat(q->min, "/", q->p50) : "-";
}

void AddScene(const PolicyScene& scene, std::string* out, std::string* notes) {
  absl::StrAppendFormat(out, "%s: %d bodies; one server: mean %.2f ms, max %.2f ms\n", SceneName(scene),
                        scene.reference.bodies, MeanMs(scene.reference), MaxMs(scene.reference));
  absl::StrAppendFormat(out, "%-16s %5s %6s %6s %6s %6s %9s %9s %8s %8s %7s %7s %9s %10s %7s  %s\n", "exchange",
                        "equal", "away", "most", "comp", "sent", "moved", "per cross", "mean ms", "max ms", "of one",
                        "waits", "wait ms", "bytes", "slack", "aims");
  for (const PolicyRun& run : scene.runs) {
    const PolicyFigures f = FiguresOf(run, scene);
    const RunMeasure& m = run.measure;
    absl::StrAppendFormat(out, "%-16s %5s %6.4f %6.3f %6d %6d %9d %9s %8.2f %8.2f %7.3f %7.2f %9.3f %10.0f %7s  %s\n",
                          run.exchange.Name(), run.comparison.hash_equal ? "yes" : "NO", f.away, f.most_hosted,
                          m.largest_component, m.largest_cluster, m.bodies_moved, OrDash(f.moves, 2), f.mean_ms,
                          f.max_ms, f.of_one, f.waits, f.wait_ms, f.bytes, SlackText(m),
                          BarText(f, BarOf(run.exchange, scene.density)));
    if (run.Exact()) continue;
    absl::StrAppendFormat(notes, "%s, %s: NOT EXACT: ", SceneName(scene), run.exchange.Name());
    if (!run.comparison.hash_equal) {
      absl::StrAppendFormat(notes, "differs from the undivided run, first at tick %d; ",
                            run.comparison.first_difference);
    }
    absl::StrAppendFormat(notes, "%d lost, %d doubled, %d violations.\n", run.comparison.lost, run.comparison.doubled,
                          m.violations);
  }
  absl::StrAppend(out, "\n");
}

constexpr char kLegend[] =
    "away: share of body-ticks hosted away from home. most: share on the region that hosted most; 0.5 is fair. comp:\n"
    "bodies of the largest component that several owners had a part in; 0: none had. sent: bodies of the largest\n"
    "transfer. moved: bodies, in all transfers; per cross: for each crossing of the border. mean, max: frame time of\n"
    "the busiest server, CPU outside of waits; of one: its mean over the undivided one. waits, wait ms: per tick and\n"
    "server, on this machine, without a wall clock to wait for. bytes: payload per tick, link and direction. slack: "
    "ticks from\n"
    "a body's arrival at others to its first touch of one, least and median.\n";

Json RunJson(const PolicyRun& run, const PolicyScene& scene) {
  const PolicyFigures f = FiguresOf(run, scene);
  const RunMeasure& m = run.measure;
  const std::optional<PolicyBar> bar = BarOf(run.exchange, scene.density);
  Json out = {{"exchange_delay", run.exchange.k},
              {"policy", nullptr},
              {"hash_equal", run.comparison.hash_equal},
              {"hash_ticks", run.comparison.ticks},
              {"first_difference", nullptr},
              {"lost", run.comparison.lost},
              {"doubled", run.comparison.doubled},
              {"violations", m.violations},
              {"largest_component", m.largest_component},
              {"largest_cluster", m.largest_cluster},
              {"transfers", m.transfers},
              {"bodies_moved", m.bodies_moved},
              {"home_crossings", m.home_crossings},
              {"away_from_home", f.away},
              {"most_hosted", f.most_hosted},
              {"transfers_per_home_crossing", nullptr},
              {"moves_per_home_crossing", nullptr},
              {"mean_frame_ms", f.mean_ms},
              {"max_frame_ms", f.max_ms},
              {"ratio", f.of_one},
              {"waits_per_tick", f.waits},
              {"wait_ms_per_tick", f.wait_ms},
              {"bytes_per_tick_and_link", f.bytes},
              {"slack_at_first_touch", SlackJson(m)},
              {"wall_s", m.wall_seconds},
              {"aims", nullptr}};
  if (run.exchange.k > 0) out["policy"] = run.exchange.reach ? "reach" : "tolerance";
  if (run.comparison.first_difference > 0) out["first_difference"] = run.comparison.first_difference;
  if (const auto transfers = m.TransfersPerHomeCrossing()) out["transfers_per_home_crossing"] = *transfers;
  if (f.moves) out["moves_per_home_crossing"] = *f.moves;
  if (bar) {
    out["aims"] = {{"away_from_home", bar->away},
                   {"away_from_home_met", AwayMet(f, *bar)},
                   {"moves_per_home_crossing", bar->moves},
                   {"moves_per_home_crossing_met", MovesMet(f, *bar)}};
  }
  return out;
}

}  // namespace

std::string ExchangeChoice::Name() const {
  if (k == 0) return "k = 0";
  return absl::StrFormat("%s, k = %d", reach ? "reach" : "tolerance", k);
}

bool PolicyTable::Exact() const {
  return std::all_of(scenes.begin(), scenes.end(), [](const PolicyScene& s) {
    return std::all_of(s.runs.begin(), s.runs.end(), [](const PolicyRun& r) { return r.Exact(); });
  });
}

PolicyFigures FiguresOf(const PolicyRun& run, const PolicyScene& scene) {
  const RunMeasure& m = run.measure;
  PolicyFigures out;
  out.away = m.AwayFromHome();
  out.moves = m.MovesPerHomeCrossing();
  out.mean_ms = MeanMs(m);
  out.max_ms = MaxMs(m);
  if (const double one = MeanMs(scene.reference); one > 0) out.of_one = out.mean_ms / one;
  for (const RegionMeasure& r : m.regions) {
    if (m.body_ticks == 0) break;
    out.most_hosted = std::max(out.most_hosted, static_cast<double>(r.body_ticks) / static_cast<double>(m.body_ticks));
  }
  const auto regions = static_cast<double>(m.regions.size());
  const double laps = static_cast<double>(scene.ticks) * regions;
  if (laps > 0) {
    out.waits = static_cast<double>(m.waits) / laps;
    out.wait_ms = static_cast<double>(m.wait_us) * 1e-3 / laps;
    if (regions > 1) out.bytes = static_cast<double>(m.bytes_sent) / laps / (regions - 1);
  }
  return out;
}

std::optional<PolicyBar> BarOf(const ExchangeChoice& exchange, double density) {
  if (exchange.k == 0 && density <= 1) return PolicyBar{0.01, 3};
  if (exchange.k == 1 && exchange.reach && density == 0.2) return PolicyBar{0.03, 4};
  return std::nullopt;
}

const PolicyRun* Fastest(const PolicyScene& scene) {
  const PolicyRun* best = nullptr;
  for (const PolicyRun& run : scene.runs) {
    if (run.Exact() && (best == nullptr || MeanMs(run.measure) < MeanMs(best->measure))) best = &run;
  }
  return best;
}

std::optional<std::pair<ExchangeChoice, double>> FastestOverall(const PolicyTable& table) {
  std::optional<std::pair<ExchangeChoice, double>> best;
  for (size_t i = 0; i < kExchangeChoices.size(); ++i) {
    double sum = 0;
    int scenes = 0;
    bool exact = true;
    for (const PolicyScene& scene : table.scenes) {
      if (scene.runs.size() < kExchangeChoices.size()) continue;
      exact &= scene.runs[i].Exact();
      sum += FiguresOf(scene.runs[i], scene).of_one;
      ++scenes;
    }
    if (!exact || scenes == 0) continue;
    if (!best || sum / scenes < best->second) best = {kExchangeChoices[i], sum / scenes};
  }
  return best;
}

std::string TableText(const PolicyTable& table) {
  std::string out = absl::StrFormat(
      "80 x 30 m in two columns, %g s, seed %d, 1 %% of the bodies kicked per tick. slow: kicks up to 5 m/s; fast: 2 "
      "%% "
      "of\nthem up to 32 m/s.\n\n",
      table.duration_s, table.seed);
  std::string notes;
  for (const PolicyScene& scene : table.scenes) AddScene(scene, &out, &notes);
  absl::StrAppend(&out, kLegend, "\n", notes, "Lowest mean frame time of the busiest server:\n");
  for (const PolicyScene& scene : table.scenes) {
    if (const PolicyRun* best = Fastest(scene)) {
      absl::StrAppendFormat(&out, "  %-24s %-16s %.3f of one server\n", SceneName(scene), best->exchange.Name(),
                            FiguresOf(*best, scene).of_one);
    }
  }
  if (const auto best = FastestOverall(table)) {
    absl::StrAppendFormat(&out, "  %-24s %-16s %.3f of one server, on average\n", "overall", best->first.Name(),
                          best->second);
  }
  return out;
}

Json ToJson(const PolicyTable& table) {
  Json out = {{"duration_s", table.duration_s},
              {"seed", table.seed},
              {"repeat", table.repeat},
              {"real_time", false},
              {"fastest", nullptr},
              {"scenes", Json::array()}};
  if (const auto best = FastestOverall(table))
    out["fastest"] = {{"exchange", best->first.Name()}, {"ratio", best->second}};
  for (const PolicyScene& scene : table.scenes) {
    Json one = {{"world", scene.world},
                {"density", scene.density},
                {"kicks", scene.fast ? "fast" : "slow"},
                {"bodies", scene.reference.bodies},
                {"ticks", scene.ticks},
                {"one_server", {{"mean_frame_ms", MeanMs(scene.reference)}, {"max_frame_ms", MaxMs(scene.reference)}}},
                {"fastest", nullptr},
                {"runs", Json::array()}};
    if (const PolicyRun* best = Fastest(scene)) one["fastest"] = best->exchange.Name();
    for (const PolicyRun& run : scene.runs) one["runs"].push_back(RunJson(run, scene));
    out["scenes"].push_back(std::move(one));
  }
  return out;
}

std::string ToCsv(const PolicyTable& table) {
  std::string csv =
      "world,density,kicks,policy,k,hash_equal,violations,away,most_hosted,largest_component,largest_cluster,"
      "transfers,bodies_moved,home_crossings,mean_frame_ms,max_frame_ms,of_one,waits_per_tick,wait_ms_per_tick,"
      "bytes_per_tick_and_link,slack_min,slack_p50\n";
  for (const PolicyScene& scene : table.scenes) {
    for (const PolicyRun& run : scene.runs) {
      const PolicyFigures f = FiguresOf(run, scene);
      const RunMeasure& m = run.measure;
      const std::optional<SlackQuantiles> slack = QuantilesOf(m.slack);
      const char* policy = run.exchange.k == 0 ? "" : run.exchange.reach ? "reach" : "tolerance";
      absl::StrAppendFormat(&csv, "%s,%g,%s,%s,%d,%d,%d,%.6f,%.4f,%d,%d,%d,%d,%d,%.4f,%.4f,%.4f,%.4f,%.4f,%.1f,%s,%s\n",
                            scene.world, scene.density, scene.fast ? "fast" : "slow", policy, run.exchange.k,
                            run.comparison.hash_equal ? 1 : 0, m.violations, f.away, f.most_hosted, m.largest_component,
                            m.largest_cluster, m.transfers, m.bodies_moved, m.home_crossings, f.mean_ms, f.max_ms,
                            f.of_one, f.waits, f.wait_ms, f.bytes, slack ? absl::StrCat(slack->min) : "",
                            slack ? absl::StrCat(slack->p50) : "");
    }
  }
  return csv;
}

}  // namespace aureole
