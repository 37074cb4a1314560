// The results of `aureole experiment --policies` as a table, JSON and CSV. Pure functions.
#pragma once

#include <array>
#include <optional>
#include <string>
#include <vector>

#include <nlohmann/json_fwd.hpp>

#include "client/cli/measure.h"

namespace aureole {

// One column of the question: how regions exchange.
struct ExchangeChoice {
  int k = 0;
  bool reach = false;  // k >= 1: the `reach` policy, else `tolerance`
  std::string Name() const;
};

inline constexpr std::array<ExchangeChoice, 5> kExchangeChoices{
    {{0, false}, {1, true}, {2, true}, {1, false}, {2, false}}};

struct PolicyRun {
  ExchangeChoice exchange;
  RunMeasure measure;
  Comparison comparison;
  bool Exact() const {
    return comparison.hash_equal && comparison.lost == 0 && comparison.doubled == 0 && measure.violations == 0;
  }
};

// One crowd under each exchange.
struct PolicyScene {
  std::string world;
  double density = 0;  // bodies/m^2
  bool fast = false;
  Tick ticks = 0;
  RunMeasure reference;  // undivided
  std::vector<PolicyRun> runs;
};

struct PolicyTable {
  uint64_t seed = 1;
  double duration_s = 0;
  int repeat = 1;
  std::vector<PolicyScene> scenes;
  bool Exact() const;
};

// What a run's counts come to. Frame time as in measure.h; the busiest server is the one with the largest mean.
struct PolicyFigures {
  double away = 0;                 // share of body-ticks hosted away from home
  double most_hosted = 0;          // share of body-ticks on the region that hosted most
  std::optional<double> moves;     // of bodies between owners, for each crossing of a border of homes
  double mean_ms = 0, max_ms = 0;  // frame time of the busiest server
  double of_one = 0;               // mean_ms over that of the undivided run
  double waits = 0, wait_ms = 0;   // per tick and server
  double bytes = 0;                // payload per tick, link and direction
};
PolicyFigures FiguresOf(const PolicyRun& run, const PolicyScene& scene);

// What we aim at: bounds on `away` and `moves`, where we have any.
struct PolicyBar {
  double away = 0, moves = 0;
};
std::optional<PolicyBar> BarOf(const ExchangeChoice& exchange, double density);

// The exact run with the lowest mean frame time of its busiest server; nothing when no run is exact.
const PolicyRun* Fastest(const PolicyScene& scene);
// The exchange whose mean `of_one`, over all scenes that every exchange has run, is lowest, with that mean. An exchange
// that was not exact everywhere is out.
std::optional<std::pair<ExchangeChoice, double>> FastestOverall(const PolicyTable& table);

std::string TableText(const PolicyTable& table);
nlohmann::ordered_json ToJson(const PolicyTable& table);
std::string ToCsv(const PolicyTable& table);  // one line per run

}  // namespace aureole
