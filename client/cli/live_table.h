// The state of a running world as text: a table that is redrawn in place, or a plain line.
#pragma once

#include <cstdio>
#include <string>
#include <vector>

#include "server/control/run_status.h"

namespace aureole {

struct Heading {
  std::string world;
  int64_t tick_us = 16000;
  Tick last_tick = 0;  // 0: no end
};

// One row per region, a row of totals, and what the run waits for. Frame times are those of the last second.
std::vector<std::string> TableLines(const Heading& heading, const RunStatus& status);
std::string PlainLine(const Heading& heading, const RunStatus& status);
// Where clients reach the region servers, in order.
std::string ServersLine(const RunStatus& status);

// "4.2 kB", "17 MB"; powers of 1000.
std::string HumanBytes(double bytes);

// Draws lines over those it drew before. Lines are cut at the terminal's width, so that none wraps.
class Screen {
 public:
  explicit Screen(std::FILE* terminal) : terminal_(terminal) {}
  void Draw(const std::vector<std::string>& lines);

 private:
  std::FILE* terminal_;
  size_t drawn_ = 0;
};

}  // namespace aureole
