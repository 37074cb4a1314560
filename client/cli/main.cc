// aureole: the command line of Aureole.
#include <CLI/CLI.hpp>
#include <string>

#include "client/cli/act.h"
#include "client/cli/certificates.h"
#include "client/cli/check.h"
#include "client/cli/completion.h"
#include "client/cli/doctor.h"
#include "client/cli/exit_codes.h"
#include "client/cli/experiment.h"
#include "client/cli/load.h"
#include "client/cli/operate.h"
#include "client/cli/record.h"
#include "client/cli/replay.h"
#include "client/cli/report.h"
#include "client/cli/token.h"
#include "client/cli/top.h"
#include "client/cli/up.h"
#include "client/cli/watch.h"
#include "server/control/interrupts.h"

int main(int argc, char** argv) {
  aureole::CatchInterrupts();
  CLI::App app{"Aureole: one rigid-body world on many servers, with the answer of one."};
  app.name("aureole");
  app.set_version_flag("--version", AUREOLE_VERSION);
  app.require_subcommand(1);
  app.footer(std::string("Examples:\n"
                         "  aureole up tests/worlds/demo.json\n"
                         "  aureole experiment tests/worlds/paper/column-*.json\n"
                         "  aureole check tests/worlds/*.json\n"
                         "  aureole watch --server 127.0.0.1:40001\n"
                         "  aureole record --server 127.0.0.1:40001 --out run.mcap --duration 10s\n"
                         "  aureole replay run.mcap --verify\n"
                         "  aureole up --help\n\n") +
             aureole::kExitCodesHelp);

  aureole::UpOptions up_options;
  aureole::ExperimentOptions experiment_options;
  aureole::CheckOptions check_options;
  aureole::LoadOptions load_options;
  aureole::PushOptions push_options;
  aureole::SpawnOptions spawn_options;
  aureole::RemoveOptions remove_options;
  aureole::RayOptions ray_options;
  aureole::WatchCliOptions watch_options;
  aureole::RecordOptions record_options;
  aureole::ReplayOptions replay_options;
  aureole::ReportOptions report_options;
  aureole::TopOptions top_options;
  aureole::DoctorOptions doctor_options;
  aureole::CompletionOptions completion_options;
  aureole::CertificatesOptions certificates_options;
  aureole::TokenOptions token_options;
  aureole::OperateOptions operate_options;
  const CLI::App* up = aureole::AddUp(app, &up_options);
  const CLI::App* experiment = aureole::AddExperiment(app, &experiment_options);
  const CLI::App* watch = aureole::AddWatch(app, &watch_options);
  const CLI::App* push = aureole::AddPush(app, &push_options);
  const CLI::App* spawn = aureole::AddSpawn(app, &spawn_options);
  const CLI::App* ray = aureole::AddRay(app, &ray_options);
  const CLI::App* remove = aureole::AddRemove(app, &remove_options);
  const CLI::App* top = aureole::AddTop(app, &top_options);
  const CLI::App* record = aureole::AddRecord(app, &record_options);
  const CLI::App* replay = aureole::AddReplay(app, &replay_options);
  const CLI::App* report = aureole::AddReport(app, &report_options);
  const CLI::App* load = aureole::AddLoad(app, &load_options);
  const CLI::App* doctor = aureole::AddDoctor(app, &doctor_options);
  const CLI::App* certificates = aureole::AddCertificates(app, &certificates_options);
  const CLI::App* token = aureole::AddToken(app, &token_options);
  const CLI::App* world = aureole::AddWorld(app, &operate_options);
  const CLI::App* events = aureole::AddEvents(app, &operate_options);
  const CLI::App* resize = aureole::AddResize(app, &operate_options);
  const CLI::App* drain = aureole::AddDrain(app, &operate_options);
  const CLI::App* checkpoint = aureole::AddCheckpoint(app, &operate_options);
  const CLI::App* completion = aureole::AddCompletion(app, &completion_options);
  aureole::AddCheck(app, &check_options);
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    return app.exit(e) == 0 ? aureole::kExitOk : aureole::kExitBadInput;
  }
  if (up->parsed()) return aureole::Up(up_options);
  if (experiment->parsed()) return aureole::RunExperiment(experiment_options);
  if (watch->parsed()) return aureole::RunWatch(watch_options);
  if (push->parsed()) return aureole::RunPush(push_options);
  if (spawn->parsed()) return aureole::RunSpawn(spawn_options);
  if (ray->parsed()) return aureole::RunRay(ray_options);
  if (remove->parsed()) return aureole::RunRemove(remove_options);
  if (top->parsed()) return aureole::RunTop(top_options);
  if (doctor->parsed()) return aureole::RunDoctor(doctor_options);
  if (completion->parsed()) return aureole::RunCompletion(app, completion_options);
  if (certificates->parsed()) return aureole::RunCertificates(certificates_options);
  if (token->parsed()) return aureole::RunToken(token_options);
  if (world->parsed()) return aureole::RunWorldCommand(operate_options);
  if (events->parsed()) return aureole::RunEvents(operate_options);
  if (resize->parsed()) return aureole::RunResize(operate_options);
  if (drain->parsed()) return aureole::RunDrain(operate_options);
  if (checkpoint->parsed()) return aureole::RunCheckpoint(operate_options);
  if (record->parsed()) return aureole::RunRecord(record_options);
  if (replay->parsed()) return aureole::RunReplay(replay_options);
  if (report->parsed()) return aureole::RunReport(report_options);
  if (load->parsed()) return aureole::RunLoad(load_options);
  return aureole::Check(check_options);
}
