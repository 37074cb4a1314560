#include "client/cli/experiment.h"

#include <google/protobuf/io/coded_stream.h>
#include <google/protobuf/io/zero_copy_stream_impl_lite.h>

#include <algorithm>
#include <filesystem>
#include <iostream>
#include <map>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <nlohmann/json.hpp>

#include "client/cli/exit_codes.h"
#include "client/cli/experiment_report.h"
#include "client/cli/flags.h"
#include "client/cli/measured_runs.h"
#include "client/cli/output_directory.h"
#include "client/cli/policies.h"
#include "server/control/run.h"
#include "server/control/world_file.h"

namespace aureole {
namespace {

constexpr Tick kHashEvery = 100;
constexpr double kDefaultDuration = 60;  // s

class Experimenter {
 public:
  explicit Experimenter(const ExperimentOptions& options) : options_(options) {
    experiment_.duration_s = options.duration_s > 0 ? options.duration_s : kDefaultDuration;
    experiment_.repeat = options.repeat;
    experiment_.real_time = !options.no_real_time;
    experiment_.hash_every = kHashEvery;
  }

  // One run of each world, each content's undivided run before the first of its worlds. Rounds follow each other, so
  // that a time in which the machine is slow falls on all worlds, and each run is compared with its own round's.
  absl::Status RunRound(const std::vector<WorldFile>& files, int round) {
    std::map<std::string, double> undivided;  // last maximum frame time of this round
    for (size_t i = 0; i < files.size(); ++i) {
      const WorldFile& file = files[i];
      std::cerr << absl::StrFormat("[%d/%d] %s, %d regions\n", round * files.size() + i + 1,
                                   options_.repeat * files.size(), file.path, file.world.layout.size());
      const std::string key = ContentKey(file.spec);
      if (!undivided.contains(key)) {
        absl::StatusOr<RunMeasure> run = Run(file, true, round);
        if (!run.ok()) return run.status();
        undivided[key] = run->LastMaxFrameMs();
        references_[key].push_back(*std::move(run));
      }
      Split& split = splits_[i];
      split.file = &file;
      split.key = key;
      if (file.world.layout.size() == 1) continue;
      absl::StatusOr<RunMeasure> run = Run(file, false, round);
      if (!run.ok()) return run.status();
      if (undivided[key] > 0) split.ratios.push_back(run->LastMaxFrameMs() / undivided[key]);
      split.runs.push_back(*std::move(run));
    }
    return absl::OkStatus();
  }

  // Of the rounds so far; worlds that have not run are left out.
  void Summarise() {
    std::map<std::string, size_t> places;
    for (const auto& [index, split] : splits_) {
      const WorldFile& file = *split.file;
      const std::vector<RunMeasure>& undivided = references_.at(split.key);
      const auto [place, fresh] = places.try_emplace(split.key, experiment_.references.size());
      if (fresh) experiment_.references.push_back({file.world.name, MedianOf(undivided)});
      Row row;
      row.world = file.world.name;
      row.file = file.path;
      row.figure = FigureOf(file.spec);
      row.regions = file.world.layout.size();
      row.exchange_delay = file.world.exchange.k;
      row.reference = place->second;
      row.is_reference = row.regions == 1;
      if (!row.is_reference && split.runs.empty()) continue;
      const std::vector<RunMeasure>& runs = row.is_reference ? undivided : split.runs;
      row.measure = MedianOf(runs);
      row.ratios = split.ratios;
      const Tick last_tick = TicksIn(experiment_.duration_s, file.world.environment.tick_us);
      row.comparison = CompareAll(runs, undivided.front(), last_tick);
      experiment_.rows.push_back(std::move(row));
    }
  }

  const Experiment& experiment() const { return experiment_; }

 private:
  static Figure FigureOf(const v1::WorldSpec& spec) {
    return spec.layout().has_columns() ? Figure::kColumns : Figure::kCorners;
  }

  absl::StatusOr<RunMeasure> Run(const WorldFile& file, bool undivided, int round) {
    RunOptions run;
    run.world = file.spec;
    run.regions = file.world.layout.size();
    run.undivided = undivided;
    run.no_real_time = options_.no_real_time;
    run.last_tick = TicksIn(experiment_.duration_s, file.world.environment.tick_us);
    run.hash_every = kHashEvery;
    std::string name = absl::StrCat(file.world.name, undivided ? ", undivided" : "");
    if (options_.repeat > 1) absl::StrAppend(&name, ", ", round + 1, " of ", options_.repeat);
    return MeasuredRun(name, run, file.world.environment.tick_us, options_.region_server);
  }

  struct Split {
    const WorldFile* file = nullptr;
    std::string key;  // of its content
    std::vector<RunMeasure> runs;
    std::vector<double> ratios;
  };

  const ExperimentOptions& options_;
  Experiment experiment_;
  std::map<std::string, std::vector<RunMeasure>> references_;  // undivided runs, by content
  std::map<size_t, Split> splits_;                             // by the file's place
};

absl::Status WriteAll(const Experiment& experiment, const std::filesystem::path& directory) {
  absl::Status s = WriteText(directory / "experiment.json", ToJson(experiment).dump(2) + "\n");
  s.Update(WriteText(directory / "experiment.csv", ToCsv(experiment)));
  const std::string columns = ToSvg(experiment, Figure::kColumns), corners = ToSvg(experiment, Figure::kCorners);
  if (!columns.empty()) s.Update(WriteText(directory / "columns.svg", columns));
  if (!corners.empty()) s.Update(WriteText(directory / "corners.svg", corners));
  return s;
}

}  // namespace

std::string ContentKey(const v1::WorldSpec& spec) {
  v1::WorldSpec content = spec;
  content.clear_name();
  content.clear_description();
  content.clear_layout();
  content.clear_exchange();
  std::string bytes;
  google::protobuf::io::StringOutputStream stream(&bytes);
  google::protobuf::io::CodedOutputStream coded(&stream);
  coded.SetSerializationDeterministic(true);
  content.SerializeToCodedStream(&coded);
  coded.Trim();
  return bytes;
}

CLI::App* AddExperiment(CLI::App& app, ExperimentOptions* o) {
  CLI::App* e = app.add_subcommand("experiment", "Measure worlds split over servers, each beside the undivided world");
  CLI::Option* worlds = e->add_option("worlds", o->worlds, "World files (JSON)")->type_name("FILE");
  e->add_flag("--policies", o->policies, "Instead of worlds: compare the exchanges in crowds of 0.05 to 1 bodies/m2")
      ->excludes(worlds);
  e->add_option("--seed", o->seed, "Instead of the worlds' own seeds");
  AddDuration(e, &o->duration_s, "Simulated time of each run; when not given 60s, with --policies 20s");
  e->add_option("--repeat", o->repeat,
                "Rounds, each of one run of each world; frame times and ratios are their medians")
      ->capture_default_str()
      ->check(CLI::Range(1, 1000));
  e->add_flag("--no-real-time", o->no_real_time, "As fast as it can, not at the world's tick; --policies always does");
  e->add_option("--out", o->out, "Directory for the results: CSV, JSON and, of worlds, SVG")
      ->capture_default_str()
      ->type_name("DIR");
  e->add_flag("--json", o->json, "Print the JSON instead of the table");
  e->add_option("--region-server", o->region_server, "Program to start; aureole-region beside this one when not given")
      ->type_name("FILE");
  e->footer(
      std::string("Examples:\n"
                  "  aureole experiment tests/worlds/paper/column-*.json --out columns\n"
                  "  aureole experiment tests/worlds/paper/corner-{1,4,9}.json --no-real-time --duration 20s\n"
                  "  aureole experiment --policies --out policies\n\n"
                  "Every world runs on real processes, one server per region, and once undivided; worlds that differ\n"
                  "only in layout share that run, and a world of one region is it. The figures follow the paper's\n"
                  "Figs. 5 and 7: the maximum frame time of any server in each 5 s of simulated time.\n\n") +
      kExitCodesHelp);
  return e;
}

int RunExperiment(const ExperimentOptions& options) {
  if (options.policies) return RunPolicies(options);
  if (options.worlds.empty()) {
    std::cerr << "worlds: name at least one world file, or give --policies\n";
    return kExitBadInput;
  }
  std::vector<WorldFile> files;
  for (const std::string& path : options.worlds) {
    absl::StatusOr<WorldFile> file = OpenWorldFile(path, options.seed);
    if (!file.ok()) {
      std::cerr << file.status().message() << '\n';
      return kExitBadInput;
    }
    files.push_back(*std::move(file));
  }
  if (const absl::Status s = MakeOutputDirectory(options.out); !s.ok()) {
    std::cerr << s.message() << '\n';
    return kExitBadInput;
  }

  Experimenter experimenter(options);
  absl::Status status;
  for (int round = 0; round < options.repeat && status.ok(); ++round) status = experimenter.RunRound(files, round);
  experimenter.Summarise();
  const Experiment& experiment = experimenter.experiment();
  // What is done is worth keeping, whatever ended the rest.
  const absl::Status written = experiment.rows.empty() ? absl::OkStatus() : WriteAll(experiment, options.out);
  if (options.json) {
    std::cout << ToJson(experiment).dump(2) << std::endl;
  } else if (!experiment.rows.empty()) {
    std::cout << TableText(experiment) << "Written to " << options.out << std::endl;
  }
  const bool exact =
      std::all_of(experiment.rows.begin(), experiment.rows.end(), [](const Row& r) { return r.Exact(); });
  return ExitCode(status, written, exact);
}

}  // namespace aureole
