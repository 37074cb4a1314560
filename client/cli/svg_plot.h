// Line charts as SVG text: a title, axes with units, grid lines, a legend. Nothing else.
#pragma once

#include <string>
#include <utility>
#include <vector>

namespace aureole {

struct Series {
  std::string label;  // in the legend
  std::vector<std::pair<double, double>> points;
  bool ideal = false;  // dashed grey without markers: what would be perfect
};

struct Chart {
  std::string title;
  std::string x_label, y_label;  // with their units
  double x_step = 1;             // between grid lines, doubled until there are at most twelve
  std::vector<Series> series;    // non-negative values
};

// A document with the charts side by side under `title`, so many in a row (0: all). The axes start at 0 and end at a
// round number.
std::string RenderSvg(const std::string& title, const std::vector<Chart>& charts, int per_row = 0);

// Multiples of 1, 2 or 5 times a power of ten from 0 that cover `largest` with at most `most` intervals: 0, 5, 10, 15.
std::vector<double> RoundTicks(double largest, int most);

}  // namespace aureole
