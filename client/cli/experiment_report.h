// The results of `aureole experiment` as a table, JSON, CSV and the paper's two figures. Pure functions.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include <nlohmann/json_fwd.hpp>

#include "client/cli/measure.h"
#include "client/cli/svg_plot.h"

namespace aureole {

enum class Figure { kColumns, kCorners };  // the paper's Fig. 5 and Fig. 7

// The undivided run of one world's content, whatever its layout.
struct Reference {
  std::string world;
  RunMeasure measure;
};

struct Row {
  std::string world;
  std::string file;
  Figure figure = Figure::kColumns;
  int regions = 1;
  int exchange_delay = 0;     // k
  size_t reference = 0;       // index
  bool is_reference = false;  // one region: the undivided run itself
  RunMeasure measure;
  // In each round, of the last window's maximum frame time to that of the undivided run of the same round.
  std::vector<double> ratios;
  Comparison comparison;

  double Ideal() const { return 1.0 / regions; }
  // Their median; without rounds, the ratio of the medians.
  double Ratio(const Reference& to) const;
  // What we aim at: 1.5 / n for columns, 2 / n at corners; 1 for one region.
  double Aim() const;
  bool Exact() const {
    return comparison.hash_equal && comparison.lost == 0 && comparison.doubled == 0 && measure.violations == 0;
  }
};

struct Experiment {
  double duration_s = 0;
  int repeat = 1;
  bool real_time = true;
  Tick hash_every = 100;
  std::vector<Reference> references;
  std::vector<Row> rows;
};

// One line per run, then one for each run that missed its aim: which region, and what it could not give away.
std::string TableText(const Experiment& experiment);
nlohmann::ordered_json ToJson(const Experiment& experiment);
// One line per run and window; references first.
std::string ToCsv(const Experiment& experiment);
// Frame time over time, one curve for each number of servers, and the last window over the number of servers beside
// the ideal 1/n. Empty when the experiment has no run of this figure.
std::string ToSvg(const Experiment& experiment, Figure figure);

}  // namespace aureole
