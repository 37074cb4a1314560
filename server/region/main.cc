// aureole-region: one region server.

#include <signal.h>
#include <sys/prctl.h>
#include <unistd.h>

#include <cstdlib>
#include <iostream>
#include <string>

#include <absl/synchronization/mutex.h>
#include <spdlog/sinks/stdout_sinks.h>
#include <spdlog/spdlog.h>
#include <CLI/CLI.hpp>

#include "server/region/region_server.h"
#include "server/transport/health_check.h"

int main(int argc, char** argv) {
  CLI::App app("One region server of an Aureole world. It joins the control plane, which tells it what to simulate.");
  app.set_version_flag("--version", AUREOLE_VERSION);
  app.footer("Exit codes: 0 ended in order, or healthy; 1 could not start or join, or not healthy; 2 bad flags.");
  aureole::RegionServerOptions options;
  std::string health_check, log_level = "info";
  bool exit_with_parent = false;
  double leave_within = std::chrono::duration<double>(options.leave_within).count();
  app.add_option("--control", options.control, "host:port of the control plane");
  app.add_option("--token", options.token, "says which region this process was started for");
  app.add_option("--world", options.world,
                 "which of the control plane's worlds it is for; its only one when not given");
  app.add_option("--listen", options.listen, "host:port for peers and clients; port 0 is any")->capture_default_str();
  app.add_option("--metrics", options.metrics, "host:port of Prometheus /metrics, or off")->capture_default_str();
  app.add_option("--data", options.data, "directory for checkpoints, of this region alone; made when missing");
  app.add_option(
         "--leave-within", leave_within,
         "seconds that SIGTERM leaves for the region to leave its world in order, so that it does not stop; then, "
         "or at the next signal, the server ends and is replaced. Less than a supervisor waits before it kills")
      ->check(CLI::Range(0.0, 86400.0))
      ->capture_default_str();
  app.add_option("--tls", options.security.tls,
                 "directory with ca.crt, tls.crt and tls.key, read again when they change; plain text when not given");
  app.add_option("--tokens", options.security.tokens,
                 "file of the tokens that clients need, read again when it changes; none when not given");
  app.add_flag("--insecure", options.security.insecure,
               "allow plain text, and clients without tokens, beyond this machine");
  app.add_option("--log-level", log_level, "on standard error")
      ->check(CLI::IsMember({"debug", "info", "warn", "error", "off"}))
      ->capture_default_str();
  app.add_flag("--exit-with-parent", exit_with_parent, "end in order when the parent process dies");
  app.add_option("--health-check", health_check,
                 "only ask the server at host:port whether it is serving; without a host: that of $POD_IP");
  try {
    app.parse(argc, argv);
    if (health_check.empty() && options.control.empty()) throw CLI::RequiredError("--control");
  } catch (const CLI::ParseError& e) {
    return app.exit(e) == 0 ? 0 : 2;
  }
  options.leave_within = std::chrono::milliseconds(static_cast<int64_t>(1000 * leave_within));
  if (!health_check.empty()) {
    // Kubernetes puts no variables into a probe's command.
    if (const char* pod = std::getenv("POD_IP"); health_check[0] == ':' && pod != nullptr) health_check.insert(0, pod);
    const auto security = aureole::Security::Open(options.security);
    const absl::Status s =
        security.ok() ? aureole::CheckHealth(health_check, (*security)->channel()) : security.status();
    std::cerr << (s.ok() ? "serving" : std::string(s.message())) << "\n";
    return s.ok() ? 0 : 1;
  }

  // Debian builds Abseil with its search for deadlocks on, which gRPC then pays for at every lock.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
  aureole::BlockSignals();
  if (exit_with_parent) {
    const pid_t parent = getppid();
    prctl(PR_SET_PDEATHSIG, SIGKILL);   // even if it is stopped
    if (getppid() != parent) return 0;  // it has died already
  }
  spdlog::set_default_logger(spdlog::stderr_logger_mt("aureole-region"));
  spdlog::set_pattern("%Y-%m-%dT%H:%M:%S.%eZ %l %v", spdlog::pattern_time_type::utc);
  spdlog::set_level(spdlog::level::from_str(log_level));
  return aureole::RunRegionServer(options);
}
