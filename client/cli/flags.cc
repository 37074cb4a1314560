#include "client/cli/flags.h"

#include <absl/strings/str_cat.h>
#include <absl/time/time.h>

namespace aureole {

CLI::Option* AddDuration(CLI::App* command, double* seconds, const std::string& help) {
  const auto read = [seconds](const std::string& text) {
    absl::Duration d;
    if (!absl::ParseDuration(text, &d) || d <= absl::ZeroDuration() || d > absl::Hours(24 * 366)) {
      throw CLI::ValidationError("--duration", absl::StrCat("'", text, "' is not a time such as 60s, 2m or 500ms"));
    }
    *seconds = absl::ToDoubleSeconds(d);
  };
  return command->add_option_function<std::string>("--duration", read, help)->type_name("TIME");
}

}  // namespace aureole
