// The flags by which programs take how a world scales itself.
#pragma once

#include <map>
#include <string>

#include <absl/status/status.h>
#include <absl/strings/numbers.h>
#include <absl/strings/str_cat.h>
#include <absl/time/time.h>
#include <CLI/CLI.hpp>

#include "server/control/autoscaler.h"

namespace aureole {

// `options` outlives the parsing.
inline void AddScalingFlags(CLI::App* app, ScalingOptions* options) {
  const auto bounds = [options](const std::string& text) {
    const size_t dots = text.find("..");
    if (dots == std::string::npos || !absl::SimpleAtoi(text.substr(0, dots), &options->min_regions) ||
        !absl::SimpleAtoi(text.substr(dots + 2), &options->max_regions)) {
      throw CLI::ValidationError("--regions", absl::StrCat("'", text, "' is not MIN..MAX, such as 2..8"));
    }
  };
  CLI::Option* regions =
      app->add_option_function<std::string>("--regions", bounds,
                                            "Between how many regions the world scales itself by its load, such as "
                                            "2..8; as its layout says when not given")
          ->type_name("MIN..MAX");
  app->add_option("--frame-percent", options->frame_percent,
                  "Of the tick: what the frame time (p99) of a region may be")
      ->needs(regions)
      ->capture_default_str()
      ->type_name("PERCENT");
  app->add_option("--awake-bodies", options->awake_bodies, "How many bodies of a region may be awake; 0: any number")
      ->needs(regions)
      ->capture_default_str();
  const auto add_time = [&](const std::string& name, std::chrono::milliseconds* to, const std::string& help) {
    const auto read = [name, to](const std::string& text) {
      absl::Duration d;
      if (!absl::ParseDuration(text, &d)) {
        throw CLI::ValidationError(name, absl::StrCat("'", text, "' is not a time such as 5s or 500ms"));
      }
      *to = absl::ToChronoMilliseconds(d);
    };
    app->add_option_function<std::string>(name, read, help)
        ->needs(regions)
        ->type_name("TIME")
        ->default_str(absl::FormatDuration(absl::FromChrono(*to)));
  };
  add_time("--up-after", &options->up_after, "How long an overload lasts before there are more regions");
  add_time("--down-after", &options->down_after, "For how long fewer must have been enough before there are fewer");
}

// Nothing to say of options that were not given. InvalidArgument "--regions: ...": they are no good, or not for this
// world.
inline absl::Status CheckScalingFlags(const ScalingOptions& options, const World& world) {
  if (options == ScalingOptions()) return absl::OkStatus();
  static const std::map<std::string, std::string> kFlags = {
      {"min", "--regions: min "},          {"max", "--regions: max "},  {"framePercent", "--frame-percent: "},
      {"awakeBodies", "--awake-bodies: "}, {"upAfter", "--up-after: "}, {"downAfter", "--down-after: "}};
  if (absl::Status s = CheckScaling(options); !s.ok()) {
    const std::string message(s.message());
    const size_t colon = message.find(": ");
    return absl::InvalidArgumentError(kFlags.at(message.substr(0, colon)) + message.substr(colon + 2));
  }
  if (absl::Status s = CheckScales(options, world); !s.ok()) {
    return absl::InvalidArgumentError(absl::StrCat("--regions: ", std::string(s.message())));
  }
  return absl::OkStatus();
}

}  // namespace aureole
