#include "client/cli/svg_plot.h"

#include <algorithm>
#include <array>
#include <cmath>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/strings/str_replace.h>

namespace aureole {
namespace {

constexpr double kPlotWidth = 520, kPlotHeight = 340;
constexpr double kLeft = 64, kTop = 76, kBottom = 56, kLegendWidth = 150;
constexpr size_t kMostMarkers = 60;  // of one curve
constexpr double kChartWidth = kLeft + kPlotWidth + kLegendWidth;
constexpr double kHeight = kTop + kPlotHeight + kBottom;
constexpr double kLegendRow = 19;

// Ten hues that differ in lightness too, so that they hold in greyscale and for most kinds of colour blindness.
constexpr std::array<const char*, 10> kColours = {"#1b1b1b", "#d1495b", "#00798c", "#edae49", "#4b3f9e",
                                                  "#66a182", "#8d5a2b", "#2e86de", "#c86fc9", "#7a8b00"};

std::string Escape(const std::string& text) {
  return absl::StrReplaceAll(text, {{"&", "&amp;"}, {"<", "&lt;"}, {">", "&gt;"}, {"\"", "&quot;"}});
}

std::vector<double> Multiples(double step, double largest) {
  const int last = std::max(1, static_cast<int>(std::ceil(largest / step - 1e-9)));
  std::vector<double> out;
  for (int i = 0; i <= last; ++i) out.push_back(step * i);
  return out;
}

// Maps values to the pixels of one chart.
struct Scale {
  double left = 0, x_max = 1, y_max = 1;
  double X(double v) const { return left + v / x_max * kPlotWidth; }
  double Y(double v) const { return kTop + kPlotHeight * (1 - v / y_max); }
};

std::string Number(double v) { return absl::StrFormat("%g", v); }

void AddText(std::string* svg, double x, double y, const char* anchor, int size, const std::string& text,
             const std::string& more = "") {
  absl::StrAppendFormat(svg, "<text x=\"%.1f\" y=\"%.1f\" text-anchor=\"%s\" font-size=\"%d\"%s>%s</text>\n", x, y,
                        anchor, size, more, Escape(text));
}

void AddLine(std::string* svg, double x1, double y1, double x2, double y2, const std::string& style) {
  absl::StrAppendFormat(svg, "<line x1=\"%.1f\" y1=\"%.1f\" x2=\"%.1f\" y2=\"%.1f\" %s/>\n", x1, y1, x2, y2, style);
}

void AddAxes(std::string* svg, const Chart& chart, const Scale& scale, const std::vector<double>& x_ticks,
             const std::vector<double>& y_ticks) {
  const double right = scale.left + kPlotWidth, bottom = kTop + kPlotHeight;
  for (const double t : y_ticks) {
    AddLine(svg, scale.left, scale.Y(t), right, scale.Y(t), "stroke=\"#dddddd\"");
    AddText(svg, scale.left - 8, scale.Y(t) + 4, "end", 12, Number(t));
  }
  for (const double t : x_ticks) {
    AddLine(svg, scale.X(t), kTop, scale.X(t), bottom, "stroke=\"#eeeeee\"");
    AddText(svg, scale.X(t), bottom + 18, "middle", 12, Number(t));
  }
  AddLine(svg, scale.left, bottom, right, bottom, "stroke=\"#333333\"");
  AddLine(svg, scale.left, kTop, scale.left, bottom, "stroke=\"#333333\"");
  AddText(svg, scale.left + kPlotWidth / 2, kTop - 14, "middle", 14, chart.title);
  AddText(svg, scale.left + kPlotWidth / 2, bottom + 42, "middle", 13, chart.x_label);
  const double y_x = scale.left - 46, y_y = kTop + kPlotHeight / 2;
  AddText(svg, y_x, y_y, "middle", 13, chart.y_label,
          absl::StrFormat(" transform=\"rotate(-90 %.1f %.1f)\"", y_x, y_y));
}

std::string Stroke(const Series& series, const std::string& colour) {
  return absl::StrFormat("stroke=\"%s\" %s", colour,
                         series.ideal ? "stroke-width=\"1.5\" stroke-dasharray=\"6 4\"" : "stroke-width=\"2\"");
}

void AddSeries(std::string* svg, const Series& series, const Scale& scale, const std::string& colour) {
  std::string points;
  for (const auto& [x, y] : series.points) absl::StrAppendFormat(&points, "%.1f,%.1f ", scale.X(x), scale.Y(y));
  absl::StrAppend(svg, "<polyline fill=\"none\" points=\"", points, "\" ", Stroke(series, colour), "/>\n");
  if (series.ideal || series.points.size() > kMostMarkers) return;
  for (const auto& [x, y] : series.points) {
    absl::StrAppendFormat(svg, "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"2.6\" fill=\"%s\"/>\n", scale.X(x), scale.Y(y),
                          colour);
  }
}

void AddChart(std::string* svg, const Chart& chart, double left) {
  double x_max = 0, y_max = 0;
  for (const Series& s : chart.series) {
    for (const auto& [x, y] : s.points) {
      x_max = std::max(x_max, x);
      y_max = std::max(y_max, y);
    }
  }
  double step = chart.x_step;
  while (x_max > 12 * step) step *= 2;
  const std::vector<double> x_ticks = Multiples(step, x_max), y_ticks = RoundTicks(y_max, 8);
  const Scale scale{left + kLeft, x_ticks.back(), y_ticks.back()};
  AddAxes(svg, chart, scale, x_ticks, y_ticks);
  const double legend = scale.left + kPlotWidth + 14;
  size_t curves = 0;
  for (size_t i = 0; i < chart.series.size(); ++i) {
    const Series& s = chart.series[i];
    const std::string colour = s.ideal ? "#888888" : kColours[curves++ % kColours.size()];
    AddSeries(svg, s, scale, colour);
    const double y = kTop + 8 + kLegendRow * static_cast<double>(i);
    AddLine(svg, legend, y, legend + 24, y, Stroke(s, colour));
    AddText(svg, legend + 31, y + 4, "start", 12, s.label);
  }
}

}  // namespace

std::vector<double> RoundTicks(double largest, int most) {
  if (!(largest > 0)) largest = 1;
  double step = std::pow(10, std::floor(std::log10(largest / most)));
  for (const double factor : {1, 2, 5, 10}) {
    if (largest / (step * factor) <= most) {
      step *= factor;
      break;
    }
  }
  return Multiples(step, largest);
}

std::string RenderSvg(const std::string& title, const std::vector<Chart>& charts, int per_row) {
  const size_t columns = per_row > 0 ? std::min(charts.size(), static_cast<size_t>(per_row)) : charts.size();
  const size_t rows = columns == 0 ? 1 : (charts.size() + columns - 1) / columns;
  const double width = kChartWidth * static_cast<double>(columns), height = kHeight * static_cast<double>(rows);
  std::string svg = absl::StrFormat(
      "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%.0f\" height=\"%.0f\" viewBox=\"0 0 %.0f %.0f\" "
      "font-family=\"Helvetica, Arial, sans-serif\" fill=\"#222222\">\n"
      "<rect width=\"100%%\" height=\"100%%\" fill=\"white\"/>\n",
      width, height, width, height);
  AddText(&svg, width / 2, 28, "middle", 18, title);
  for (size_t row = 0; row < rows; ++row) {
    if (row > 0) svg += absl::StrFormat("<g transform=\"translate(0 %.0f)\">\n", kHeight * static_cast<double>(row));
    for (size_t i = row * columns; i < std::min(charts.size(), (row + 1) * columns); ++i) {
      AddChart(&svg, charts[i], kChartWidth * static_cast<double>(i - row * columns));
    }
    if (row > 0) svg += "</g>\n";
  }
  return svg + "</svg>\n";
}

}  // namespace aureole
