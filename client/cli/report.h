// aureole report: what happened in a recording, as charts.
#pragma once

#include <string>

#include <CLI/CLI.hpp>

namespace aureole {

struct ReportOptions {
  std::string file, out;
  bool json = false;
};

CLI::App* AddReport(CLI::App& app, ReportOptions* options);
int RunReport(const ReportOptions& options);

}  // namespace aureole
