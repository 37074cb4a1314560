#include "client/cli/check.h"

#include <iostream>

#include "client/cli/exit_codes.h"
#include "server/control/world_file.h"

namespace aureole {

CLI::App* AddCheck(CLI::App& app, CheckOptions* o) {
  CLI::App* check = app.add_subcommand("check", "Say whether world files are sane, and what their layouts mean");
  check->add_option("worlds", o->worlds, "World files (JSON)")->required()->type_name("FILE");
  check->footer(std::string("Example:\n  aureole check tests/worlds/*.json\n\n"
                            "Prints the layout's chain number m and, in figures, the paper's aura beside our margins.\n"
                            "A broken file is reported with the path of the field; nothing is started.\n") +
                kExitCodesHelp);
  return check;
}

int Check(const CheckOptions& options) {
  for (const std::string& path : options.worlds) {
    const absl::StatusOr<WorldFile> file = OpenWorldFile(path);
    if (!file.ok()) {
      std::cerr << file.status().message() << '\n';
      return kExitBadInput;
    }
    std::cout << path << '\n';
    for (const std::string& line : DescribeWorld(file->world)) std::cout << "  " << line << '\n';
  }
  return kExitOk;
}

}  // namespace aureole
