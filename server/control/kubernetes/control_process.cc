#include "server/control/kubernetes/control_process.h"

#include <grpcpp/grpcpp.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <atomic>
#include <chrono>
#include <cstdlib>
#include <iostream>
#include <memory>

#include <absl/strings/str_cat.h>
#include <absl/synchronization/mutex.h>

#include "server/control/control_hub.h"
#include "server/control/control_port.h"
#include "server/control/interrupts.h"
#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/cluster_access.h"
#include "server/control/kubernetes/control_metrics.h"
#include "server/control/kubernetes/event_recorder.h"
#include "server/control/kubernetes/leader_elector.h"
#include "server/control/kubernetes/own_pod.h"
#include "server/control/kubernetes/world_controller.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using Clock = std::chrono::steady_clock;

constexpr milliseconds kLookEvery{100};  // for signals; what happens wakes us
constexpr seconds kLabelEvery{10};

void Log(const std::string& what) { std::cerr << "[control] " << what << std::endl; }

class ControlProcess {
 public:
  ControlProcess(const ControlProcessOptions& options, ClusterAccess access)
      : options_(options),
        client_(std::move(access)),
        events_(&client_, {"aureole-control", options.pod.empty() ? "aureole-control" : options.pod}) {}

  absl::Status Serve() {
    absl::StatusOr<std::unique_ptr<Security>> security = Security::Open(options_.security);
    if (!security.ok()) return security.status();
    security_ = *std::move(security);
    if (absl::Status s = security_->CheckListen(options_.listen, true); !s.ok()) return s;
    grpc::ServerBuilder builder;
    ConfigureControlPort(&builder);
    int port = 0;
    security_->Listen(&builder, options_.listen, &port);
    security_->guard().Register(&builder, v1::Control::service_full_name(), &hub_);
    security_->guard().Register(&builder, v1::ControlPlane::service_full_name(), &hub_.operators());
    security_->guard().ServeWorlds([this](const grpc::ServerContextBase& context, const std::string& known,
                                          std::string* world) { return hub_.TokensFor(context, known, world); });
    server_ = builder.BuildAndStart();
    if (server_ == nullptr || port == 0) {
      return absl::UnavailableError(
          absl::StrCat("--listen: cannot listen on ", options_.listen, "; is the port in use?"));
    }
    port_ = port;
    if (options_.metrics == "off") return absl::OkStatus();
    absl::StatusOr<std::unique_ptr<ControlMetrics>> metrics = ControlMetrics::Serve(options_.metrics);
    if (!metrics.ok()) return metrics.status();
    metrics_ = *std::move(metrics);
    return absl::OkStatus();
  }

  void Run() {
    LeaderElector elector(&client_,
                          {client_.space(), options_.lease,
                           options_.pod.empty() ? absl::StrCat("process-", getpid()) : options_.pod, options_.election},
                          &wakeup_);
    Log(absl::StrCat("waits to lead, as ", elector.identity()));
    absl::Status told;
    while (Interrupts() == 0) {
      if (const std::optional<int64_t> epoch = elector.Epoch()) {
        Lead(elector, *epoch);
        break;
      }
      Measure(0, 0);
      if (const absl::Status s = elector.health(); s != told) {
        told = s;
        if (!s.ok()) Log(absl::StrCat("the lease: ", s.message()));
      }
      wakeup_.Wait(kLookEvery);
    }
    elector.Stop();
  }

  void Shutdown() {
    if (server_ != nullptr) server_->Shutdown(std::chrono::system_clock::now() + milliseconds(500));
  }

 private:
  // Returns with the first signal; the lease is ours then, still.
  void Lead(LeaderElector& elector, int64_t epoch) {
    Log(absl::StrCat("leads, epoch ", epoch));
    RunnerContext context;
    context.client = &client_;
    context.hub = &hub_;
    context.events = &events_;
    context.epoch = epoch;
    context.leads = [&elector, epoch] { return elector.Epoch() == epoch; };
    context.leave = &leave_;
    context.log = Log;
    absl::Status told;
    while (true) {
      const absl::Status s = Know(&context);
      if (s.ok()) break;
      if (s != told) Log(std::string(s.message()));
      told = s;
      if (!Goes(context)) return;
      wakeup_.Wait(seconds(1));
    }
    Log(absl::StrCat("region servers join at ", context.advertise));
    WorldController controller(&context, client_.space(), &wakeup_);
    Clock::time_point label;
    size_t worlds = 0;
    while (Goes(context)) {
      controller.Reconcile();
      if (controller.worlds() != worlds) Log(absl::StrCat(controller.worlds(), " worlds"));
      worlds = controller.worlds();
      Measure(epoch, worlds);
      if (!options_.pod.empty() && Clock::now() >= label) {
        const absl::Status s = LabelLeader(&client_, options_.pod);
        if (!s.ok()) Log(absl::StrCat("the label of the leader: ", s.message()));
        label = Clock::now() + (s.ok() ? kLabelEvery : seconds(1));
      }
      wakeup_.Wait(kLookEvery);
    }
    leave_ = true;
    controller.Leave();
    Log("leaves; the servers go on");
  }

  // False: a signal. A lease that is lost ends all, at once: another one may lead already.
  static bool Goes(const RunnerContext& context) {
    if (context.leads()) return Interrupts() == 0;
    Log("the lease is lost");
    std::_Exit(1);
  }

  void Measure(int64_t epoch, size_t worlds) {
    if (metrics_ != nullptr) metrics_->Update(epoch, worlds, client_.stats());
  }

  // What has to be known of our own Pod and Service before anything is started.
  absl::Status Know(RunnerContext* context) {
    context->defaults.flags = FlagsOf(options_.security);
    if (!options_.pod.empty()) {
      const absl::StatusOr<Json> pod = client_.Get({"", "v1", "pods", client_.space()}, options_.pod);
      if (!pod.ok()) return pod.status();
      context->defaults = DefaultsOf(*pod, options_.security);
    }
    if (options_.service.empty()) {
      context->advertise = absl::StrCat(options_.address, ":", port_);
      return absl::OkStatus();
    }
    absl::StatusOr<std::string> address = AddressOf(&client_, options_.service);
    if (!address.ok()) return address.status();
    context->advertise = *std::move(address);
    return absl::OkStatus();
  }

  const ControlProcessOptions& options_;
  ApiClient client_;
  EventRecorder events_;
  Wakeup wakeup_;
  std::atomic<bool> leave_ = false;
  std::unique_ptr<ControlMetrics> metrics_;
  std::unique_ptr<Security> security_;
  ControlHub hub_;
  int port_ = 0;
  std::unique_ptr<grpc::Server> server_;  // ends before the hub
};

std::string Environment(const char* name) {
  const char* const value = std::getenv(name);
  return value == nullptr ? "" : value;
}

}  // namespace

int RunControlProcess(const ControlProcessOptions& options) {
  CatchInterrupts();
  // Debian builds Abseil with its search for deadlocks on, which gRPC then pays for at every lock.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
  absl::StatusOr<ClusterAccess> access = FindAccess("");
  if (!access.ok()) {
    Log(std::string(access.status().message()));
    return 1;
  }
  if (!options.space.empty()) access->space = options.space;
  ControlProcess process(options, *std::move(access));
  if (absl::Status s = process.Serve(); !s.ok()) {
    Log(std::string(s.message()));
    return 1;
  }
  process.Run();
  process.Shutdown();
  return 0;
}

int KubernetesMain(int arguments, char** words) {
  CLI::App app(
      "The control plane of all Worlds of a namespace, with region servers as Pods. Several may run, one leads.",
      "aureole-control kubernetes");
  app.footer(
      "The environment says who this is: POD_NAME, POD_NAMESPACE, POD_IP. The API server is that of the Pod's service\n"
      "account, or of KUBECONFIG. SIGTERM: the next one leads at once, and the worlds go on.\n"
      "Exit codes: 0 ended in order, 1 could not start, or the lease was lost, 2 bad flags.");
  ControlProcessOptions options;
  options.pod = Environment("POD_NAME");
  options.space = Environment("POD_NAMESPACE");
  options.address = Environment("POD_IP");
  int lease_seconds = 15;
  app.add_option("--listen", options.listen, "where region servers join, host:port")->capture_default_str();
  app.add_option("--metrics", options.metrics, "host:port of Prometheus /metrics, or off")->capture_default_str();
  app.add_option("--namespace", options.space, "of the Worlds; that of the Pod when not given");
  app.add_option("--service", options.service, "the Service that leads region servers here; '' for none: POD_IP")
      ->capture_default_str();
  app.add_option("--lease-seconds", lease_seconds,
                 "how long the lease of a leader that fails is good for: the time until the next one leads")
      ->check(CLI::Range(3, 300))
      ->capture_default_str();
  app.add_option(
      "--tls", options.security.tls,
      "directory with ca.crt, tls.crt and tls.key, for this and the region servers; plain text when not given");
  app.add_option("--tokens", options.security.tokens, "file of the tokens that clients need; none when not given");
  app.add_flag("--insecure", options.security.insecure,
               "allow plain text, and clients without tokens, beyond this machine");
  try {
    app.parse(arguments, words);
  } catch (const CLI::ParseError& e) {
    return app.exit(e) == 0 ? 0 : 2;
  }
  options.election.duration = seconds(lease_seconds);
  options.election.renew_deadline = options.election.duration * 2 / 3;
  options.election.retry = options.election.duration * 2 / 15;
  options.security.log = Log;
  return RunControlProcess(options);
}

}  // namespace aureole::kubernetes
