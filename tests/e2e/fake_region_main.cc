// The fake region server as a process, for tests of the command line.
#include <CLI/CLI.hpp>

#include "tests/e2e/fake_region.h"

int main(int argc, char** argv) {
  CLI::App app;
  std::string control, token, data, listen;
  aureole::FakeBehaviour behaviour;
  bool with_parent = false;
  app.add_option("--control", control)->required();
  app.add_option("--token", token)->required();
  app.add_flag("--exit-with-parent", with_parent);
  app.add_option("--data", data);
  app.add_option("--listen", listen);
  app.add_option("--die-at", behaviour.die_at);
  app.add_option("--fail-region", behaviour.fail_region);
  app.add_option("--lose-at", behaviour.lose_at);
  app.add_flag("--ignore-stop", behaviour.ignore_stop);
  app.add_flag("--wrong-hash", behaviour.wrong_hash);
  CLI11_PARSE(app, argc, argv);
  return aureole::FakeRegion(control, token, behaviour).Run();
}
