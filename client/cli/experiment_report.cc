#include "client/cli/experiment_report.h"

#include <algorithm>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <nlohmann/json.hpp>

#include "client/cli/slack_json.h"
namespace aureole {
namespace {

using Json = nlohmann::ordered_json;

std::string Hex(uint64_t hash) { return absl::StrFormat("%016x", hash); }

Json WindowsJson(const RunMeasure& m) {
  Json out = Json::array();
  for (const WindowMeasure& w : m.windows) {
    out.push_back({{"t", w.t},
                   {"max_frame_ms", w.max_frame_ms},
                   {"mean_frame_ms", w.mean_frame_ms},
                   {"max_thread_ms", w.max_thread_ms},
                   {"mean_thread_ms", w.mean_thread_ms},
                   {"max_wall_ms", w.max_wall_ms},
                   {"slowest_region", w.slowest},
                   {"bodies", w.bodies}});
  }
  return out;
}

Json RegionsJson(const RunMeasure& m) {
  Json out = Json::array();
  for (const RegionMeasure& r : m.regions) {
    out.push_back({{"region", r.region},
                   {"bodies", r.bodies},
                   {"last_max_frame_ms", r.last_max_frame_ms},
                   {"largest_cluster", r.largest_cluster},
                   {"largest_component", r.largest_component},
                   {"longest_chain", r.longest_chain}});
  }
  return out;
}

Json RowJson(const Row& row, const Experiment& experiment) {
  const RunMeasure& m = row.measure;
  Json out = {{"world", row.world},
              {"file", row.file},
              {"regions", row.regions},
              {"exchange_delay", row.exchange_delay},
              {"reference", row.reference},
              {"is_reference", row.is_reference},
              {"bodies", m.bodies},
              {"hash_equal", row.comparison.hash_equal},
              {"hash_ticks", row.comparison.ticks},
              {"first_difference", nullptr},
              {"lost", row.comparison.lost},
              {"doubled", row.comparison.doubled},
              {"violations", m.violations},
              {"transfers", m.transfers},
              {"touching_transfers", m.touching_transfers},
              {"slack_at_first_touch", SlackJson(m)},
              {"largest_cluster", m.largest_cluster},
              {"largest_component", m.largest_component},
              {"longest_chain", m.longest_chain},
              {"away_from_home", m.AwayFromHome()},
              {"transfers_per_home_crossing", nullptr},
              {"moves_per_home_crossing", nullptr},
              {"bytes_sent", m.bytes_sent},
              {"waits", m.waits},
              {"wait_s", static_cast<double>(m.wait_us) * 1e-6},
              {"wall_s", m.wall_seconds},
              {"last_max_frame_ms", m.LastMaxFrameMs()},
              {"ratio", row.Ratio(experiment.references[row.reference])},
              {"ratios", row.ratios},
              {"ideal", row.Ideal()},
              {"aim", row.Aim()},
              {"windows", WindowsJson(m)},
              {"servers", RegionsJson(m)}};
  if (row.comparison.first_difference > 0) out["first_difference"] = row.comparison.first_difference;
  if (const auto transfers = m.TransfersPerHomeCrossing()) out["transfers_per_home_crossing"] = *transfers;
  if (const auto moves = m.MovesPerHomeCrossing()) out["moves_per_home_crossing"] = *moves;
  return out;
}

// Which server kept the run from its aim, and what it could not give away.
std::string MissedAim(const Row& row, const Reference& reference) {
  const auto& regions = row.measure.regions;
  const auto worst = std::max_element(regions.begin(), regions.end(), [](const auto& a, const auto& b) {
    return a.last_max_frame_ms < b.last_max_frame_ms;
  });
  if (worst == regions.end()) return "";
  return absl::StrFormat(
      "%s: %.2f of one server, aim %.2f. Region %d was slowest in the last window: %.2f ms, %d of %d bodies; its "
      "largest component over several owners had %d bodies, its largest transfer %d, the longest chain met %d "
      "owners.\n",
      row.world, row.Ratio(reference), row.Aim(), worst->region, worst->last_max_frame_ms, worst->bodies,
      row.measure.bodies, worst->largest_component, worst->largest_cluster, worst->longest_chain);
}

void AddCsv(const std::string& world, int regions, const char* kind, const RunMeasure& m, std::string* csv) {
  for (const WindowMeasure& w : m.windows) {
    absl::StrAppendFormat(csv, "%s,%s,%d,%g,%.4f,%.4f,%.4f,%.4f,%.4f,%d,%d\n", world, kind, regions, w.t,
                          w.max_frame_ms, w.mean_frame_ms, w.max_thread_ms, w.mean_thread_ms, w.max_wall_ms, w.slowest,
                          w.bodies);
  }
}

std::string Servers(int n) { return absl::StrCat(n, n == 1 ? " server" : " servers"); }

Series Curve(const std::string& label, const RunMeasure& m) {
  Series out;
  out.label = label;
  for (const WindowMeasure& w : m.windows) out.points.emplace_back(w.t, w.max_frame_ms);
  return out;
}

}  // namespace

double Row::Ratio(const Reference& to) const {
  if (!ratios.empty()) return MedianOf(ratios);
  const double one = to.measure.LastMaxFrameMs();
  return one > 0 ? measure.LastMaxFrameMs() / one : 0;
}

double Row::Aim() const {
  if (regions == 1) return 1;
  return (figure == Figure::kColumns ? 1.5 : 2.0) / regions;
}

std::string TableText(const Experiment& experiment) {
  std::string out = absl::StrFormat("%-22s %7s %7s %10s %5s %7s %10s %9s %11s %13s %6s %9s %11s\n", "world", "regions",
                                    "bodies", "hash equal", "lost", "doubled", "violations", "transfers", "last max ms",
                                    "one server ms", "ratio", "ideal 1/n", "ratio/ideal");
  std::string notes;
  for (const Row& row : experiment.rows) {
    const Reference& reference = experiment.references[row.reference];
    const double ratio = row.Ratio(reference);
    const char* equal = row.is_reference ? "reference" : row.comparison.hash_equal ? "yes" : "NO";
    absl::StrAppendFormat(&out, "%-22s %7d %7d %10s %5d %7d %10d %9d %11.2f %13.2f %6.3f %9.3f %11.2f\n", row.world,
                          row.regions, row.measure.bodies, equal, row.comparison.lost, row.comparison.doubled,
                          row.measure.violations, row.measure.transfers, row.measure.LastMaxFrameMs(),
                          reference.measure.LastMaxFrameMs(), ratio, row.Ideal(), ratio / row.Ideal());
    if (!row.comparison.hash_equal) {
      absl::StrAppendFormat(&notes, "%s: differs from the undivided run, first at tick %d (%d ticks compared)\n",
                            row.world, row.comparison.first_difference, row.comparison.ticks);
    }
    if (row.regions > 1 && ratio > row.Aim()) notes += MissedAim(row, reference);
  }
  if (!notes.empty()) absl::StrAppend(&out, "\n", notes);
  return out;
}

Json ToJson(const Experiment& experiment) {
  Json out = {{"duration_s", experiment.duration_s}, {"repeat", experiment.repeat}, {"real_time", experiment.real_time},
              {"hash_every", experiment.hash_every}, {"references", Json::array()}, {"runs", Json::array()}};
  for (const Reference& r : experiment.references) {
    Json hashes = Json::array();
    for (const TickSum& sum : r.measure.hashes) {
      hashes.push_back({{"tick", sum.tick}, {"hash", Hex(sum.hash)}, {"bodies", sum.bodies}});
    }
    out["references"].push_back({{"world", r.world},
                                 {"bodies", r.measure.bodies},
                                 {"wall_s", r.measure.wall_seconds},
                                 {"last_max_frame_ms", r.measure.LastMaxFrameMs()},
                                 {"hashes", hashes},
                                 {"windows", WindowsJson(r.measure)}});
  }
  for (const Row& row : experiment.rows) out["runs"].push_back(RowJson(row, experiment));
  return out;
}

std::string ToCsv(const Experiment& experiment) {
  std::string csv =
      "world,run,regions,window_end_s,max_frame_ms,mean_frame_ms,max_thread_ms,mean_thread_ms,max_wall_ms,"
      "slowest_region,bodies\n";
  for (const Reference& r : experiment.references) AddCsv(r.world, 1, "undivided", r.measure, &csv);
  for (const Row& row : experiment.rows) {
    if (!row.is_reference) AddCsv(row.world, row.regions, "split", row.measure, &csv);
  }
  return csv;
}

std::string ToSvg(const Experiment& experiment, Figure figure) {
  std::vector<const Row*> rows;
  std::vector<size_t> references;
  for (const Row& row : experiment.rows) {
    if (row.figure != figure) continue;
    if (!row.is_reference) rows.push_back(&row);
    if (std::find(references.begin(), references.end(), row.reference) == references.end()) {
      references.push_back(row.reference);
    }
  }
  if (references.empty()) return "";
  std::stable_sort(rows.begin(), rows.end(), [](const Row* a, const Row* b) { return a->regions < b->regions; });

  // Worlds of different content are told apart by name; those of the paper differ in their number of servers only.
  const bool one_content = references.size() == 1;
  const auto label = [one_content](const std::string& world, int n) {
    return one_content ? Servers(n) : absl::StrCat(world, " (", n, ")");
  };
  Chart over_time{"Maximum frame time of any server, per 5 s window", "simulated time, s", "max frame time, ms", 5, {}};
  Chart last{"Last window, beside the ideal", "servers", "max frame time, ms", 1, {}};
  for (const size_t r : references) {
    const RunMeasure& one = experiment.references[r].measure;
    over_time.series.push_back(Curve(label(experiment.references[r].world, 1), one));
    Series measured{one_content ? "measured" : experiment.references[r].world, {{1, one.LastMaxFrameMs()}}};
    int most = 1;
    for (const Row* row : rows) {
      if (row->reference != r) continue;
      over_time.series.push_back(Curve(label(row->world, row->regions), row->measure));
      measured.points.emplace_back(row->regions, row->measure.LastMaxFrameMs());
      most = std::max(most, row->regions);
    }
    Series ideal{"ideal 1/n", {}, true};
    for (int tenths = 10; tenths <= 10 * most; ++tenths) {
      ideal.points.emplace_back(tenths / 10.0, one.LastMaxFrameMs() * 10.0 / tenths);
    }
    last.series.push_back(std::move(measured));
    last.series.push_back(std::move(ideal));
  }
  return RenderSvg(figure == Figure::kColumns ? "Increasing numbers of servers, column layout"
                                              : "Increasing numbers of servers, corner layout",
                   {over_time, last});
}

}  // namespace aureole
