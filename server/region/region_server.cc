#include "server/region/region_server.h"

#include <pthread.h>
#include <signal.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <memory>
#include <thread>

#include <absl/strings/str_cat.h>
#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/health_check_service_interface.h>
#include <grpcpp/server.h>
#include <grpcpp/server_builder.h>
#include <spdlog/spdlog.h>

#include "server/region/control_stream.h"
#include "server/region/hosted_region.h"
#include "server/region/metrics.h"
#include "server/transport/peer_service.h"
#include "server/transport/recording_service.h"
#include "server/transport/simulation_service.h"

namespace aureole {
namespace {

constexpr uint32_t kControlProtocolVersion = 1;
// Leaving takes milliseconds. A process that is stuck in it is ended by the kernel, so that none is left behind.
constexpr unsigned kLongestLeaveSeconds = 10;

sigset_t TakenSignals() {
  sigset_t set;
  sigemptyset(&set);
  for (int signal : {SIGTERM, SIGINT, SIGUSR1}) sigaddset(&set, signal);
  return set;
}

// Turns signals into events.
class SignalThread {
 public:
  explicit SignalThread(EventQueue* events)
      : thread_([this, events] {
          const sigset_t set = TakenSignals();
          for (int signal = 0; sigwait(&set, &signal) == 0 && !done_;) {
            Event event;
            event.kind = Event::Kind::kSignal;
            event.signal = signal;
            events->Push(std::move(event));
          }
        }) {}
  ~SignalThread() {
    done_ = true;
    pthread_kill(thread_.native_handle(), SIGUSR1);
    thread_.join();
  }

 private:
  std::atomic<bool> done_ = false;
  std::thread thread_;
};

// Ends the gRPC server before the services that it uses go.
class GrpcServer {
 public:
  // Null when it cannot listen.
  static std::unique_ptr<GrpcServer> Listen(const std::string& address, Security* security,
                                            const std::vector<std::pair<const char*, grpc::Service*>>& services) {
    grpc::EnableDefaultHealthCheckService(true);
    grpc::reflection::InitProtoReflectionServerBuilderPlugin();
    grpc::ServerBuilder builder;
    ConfigureServer(&builder);
    int port = 0;
    security->Listen(&builder, address, &port);
    for (const auto& [name, service] : services) security->guard().Register(&builder, name, service);
    std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
    if (server == nullptr || port == 0) return nullptr;
    auto out = std::make_unique<GrpcServer>();
    out->server_ = std::move(server);
    out->endpoint_ = absl::StrCat(address.substr(0, address.rfind(':')), ":", port);
    out->SetServing(false);
    return out;
  }
  ~GrpcServer() {
    SetServing(false);
    server_->Shutdown(std::chrono::system_clock::now() + std::chrono::milliseconds(200));
  }

  // What the health service says.
  void SetServing(bool serving) { server_->GetHealthCheckService()->SetServingStatus(serving); }
  const std::string& endpoint() const { return endpoint_; }

 private:
  std::unique_ptr<grpc::Server> server_;
  std::string endpoint_;
};

// Everything that lives for the whole process, in the order in which it must go, last first.
struct Process {
  std::unique_ptr<Security> security;
  EventQueue events;
  std::unique_ptr<RegionMetrics> metrics;  // null: off
  PeerService peers;
  SimulationService simulation;
  RecordingService recording;
  std::string data;
  std::unique_ptr<GrpcServer> server;
  std::unique_ptr<ControlStream> control;
  std::unique_ptr<HostedRegion> hosted;

  TickLoop::Hooks Hooks();
  absl::Status Handle(const v1::ToRegion& message);
};

TickLoop::Hooks Process::Hooks() {
  TickLoop::Hooks hooks;
  hooks.after_tick = [this](const FrameSample& sample) {
    if (metrics != nullptr) metrics->AddTick(sample);
  };
  hooks.inputs = [this] { return simulation.inputs().Take(); };
  hooks.outcomes = [this](const std::vector<InputOutcome>& outcomes) { simulation.inputs().Settle(outcomes); };
  hooks.publish = [this](Region* region, int64_t bodies, const std::vector<Input>& delivered) {
    simulation.inputs().Hear(delivered);
    simulation.AfterTick(region, bodies);
    recording.AfterTick(*region, delivered);
  };
  hooks.report = [this](const v1::Report& report) {
    if (metrics != nullptr) {
      metrics->Update(report);
      metrics->UpdateRefusedLinks(hosted->links().Totals().refused_hellos + peers.refused());
    }
    simulation.Report(report);
    if (report.finished()) spdlog::info("finished at tick {}", report.tick());
    v1::FromRegion message;
    *message.mutable_report() = report;
    control->Send(std::move(message));
  };
  hooks.log = [](const std::string& what) { spdlog::warn("{}", what); };
  return hooks;
}

absl::Status Process::Handle(const v1::ToRegion& message) {
  if (message.has_assignment()) {
    if (hosted != nullptr) return absl::FailedPreconditionError("a second assignment");
    const v1::Assignment& assignment = message.assignment();
    for (const std::string& peer : assignment.endpoints()) {
      if (absl::Status s = security->CheckDial(peer); !s.ok()) return s;
    }
    absl::StatusOr<std::unique_ptr<HostedRegion>> loaded = HostedRegion::Load(assignment, data);
    if (!loaded.ok()) return loaded.status();
    hosted = *std::move(loaded);
    spdlog::info("region {} of {}, world {}, {} bodies, k = {}, tick {} us, layout epoch {}, last tick {}, {}",
                 assignment.region(), assignment.endpoints_size(), hosted->world().name,
                 hosted->region().engine().Counts().bodies, hosted->world().exchange.k,
                 hosted->world().environment.tick_us, assignment.layout_epoch(), assignment.last_tick(),
                 assignment.no_real_time() ? "as fast as it can" : "in real time");
    if (metrics != nullptr) metrics->Assigned(hosted->world().name, assignment.region());
    security->guard().ServeWorld(hosted->world().name);
    hosted->Connect(&peers, security->channel());
    v1::FromRegion ready;
    ready.mutable_ready()->set_bodies(hosted->region().engine().Counts().bodies);
    ready.mutable_ready()->set_tick(hosted->region().tick());
    control->Send(std::move(ready));
  } else if (message.has_start()) {
    if (hosted == nullptr) return absl::FailedPreconditionError("a start without an assignment");
    simulation.Serve(hosted->assignment(), hosted->world());
    recording.Serve(hosted->assignment().region(), hosted->assignment().world(), hosted->world().exchange.k == 0);
    hosted->Start(message.start().start_unix_us(), Hooks());
    server->SetServing(true);
  } else if (message.has_peer_moved()) {
    if (hosted == nullptr) return absl::FailedPreconditionError("a peer has moved before the assignment");
    if (absl::Status s = security->CheckDial(message.peer_moved().endpoint()); !s.ok()) return s;
    spdlog::info("region {} is incarnation {} now, at {}", message.peer_moved().region(),
                 message.peer_moved().incarnation(), message.peer_moved().endpoint());
    hosted->PeerMoved(message.peer_moved());
  }
  return absl::OkStatus();
}

// True when the process should go on.
bool HandleEvent(Process* process, const Event& event, int* exit_code, std::string* reason) {
  switch (event.kind) {
    case Event::Kind::kSignal:
      if (event.signal == SIGUSR1) {
        spdlog::warn("SIGUSR1: cutting every link");
        if (process->hosted != nullptr) process->hosted->links().CutAll();
        return true;
      }
      *reason = strsignal(event.signal);
      return false;
    case Event::Kind::kControlLost:
      *reason = "control plane lost: " + event.reason;
      // Nobody to serve when there never was an assignment.
      if (process->hosted == nullptr) *exit_code = 1;
      return false;
    case Event::Kind::kMessage:
      break;
  }
  if (event.message.has_stop()) {
    *reason = "stopped: " + event.message.stop().reason();
    return false;
  }
  const absl::Status s = process->Handle(event.message);
  if (s.ok()) return true;
  *exit_code = 1;
  *reason = "the control plane's message was refused: " + std::string(s.message());
  return false;
}

// With what it listens on and dials checked.
absl::StatusOr<std::unique_ptr<Security>> OpenSecurity(const RegionServerOptions& options) {
  SecurityOptions with_log = options.security;
  with_log.log = [](const std::string& what) { spdlog::warn("{}", what); };
  absl::StatusOr<std::unique_ptr<Security>> out = Security::Open(with_log);
  if (!out.ok()) return out;
  if (absl::Status s = (*out)->CheckListen(options.listen, true); !s.ok()) return s;
  if (absl::Status s = (*out)->CheckDial(options.control); !s.ok()) {
    return absl::Status(s.code(), absl::StrCat("--control: ", s.message()));
  }
  return out;
}

}  // namespace

void BlockSignals() {
  const sigset_t set = TakenSignals();
  pthread_sigmask(SIG_BLOCK, &set, nullptr);
}

int RunRegionServer(const RegionServerOptions& options) {
  Process process;
  process.data = options.data;
  absl::StatusOr<std::unique_ptr<Security>> security = OpenSecurity(options);
  if (!security.ok()) {
    spdlog::error("{}", std::string(security.status().message()));
    return 1;
  }
  process.security = *std::move(security);
  const SignalThread signals(&process.events);
  if (options.metrics != "off") {
    absl::StatusOr<std::unique_ptr<RegionMetrics>> metrics = RegionMetrics::Serve(options.metrics);
    if (!metrics.ok()) {
      spdlog::error("{}", std::string(metrics.status().message()));
      return 1;
    }
    process.metrics = *std::move(metrics);
  }
  process.server = GrpcServer::Listen(options.listen, process.security.get(),
                                      {{v1::Peer::service_full_name(), &process.peers},
                                       {v1::Simulation::service_full_name(), &process.simulation},
                                       {v1::Recording::service_full_name(), &process.recording}});
  if (process.server == nullptr) {
    spdlog::error("--listen: cannot listen on {}; choose another host:port, or port 0", options.listen);
    return 1;
  }
  v1::Hello hello;
  hello.set_protocol_version(kControlProtocolVersion);
  hello.set_token(options.token);
  hello.set_endpoint(process.server->endpoint());
  hello.set_metrics_endpoint(process.metrics != nullptr ? process.metrics->endpoint() : "");
  hello.set_pid(getpid());
  spdlog::info("aureole-region: pid {}, control {}, peers and clients {}, metrics {}", getpid(), options.control,
               process.server->endpoint(), process.metrics != nullptr ? process.metrics->endpoint() : "off");
  process.control =
      std::make_unique<ControlStream>(options.control, process.security->channel(), hello, &process.events);

  int exit_code = 0;
  std::string reason;
  while (HandleEvent(&process, process.events.Pop(), &exit_code, &reason)) {
  }
  spdlog::log(exit_code == 0 ? spdlog::level::info : spdlog::level::err, "leaving: {}", reason);
  alarm(kLongestLeaveSeconds);
  process.server->SetServing(false);
  process.simulation.Stop();
  process.recording.Stop();
  if (process.hosted != nullptr) {
    process.hosted->Stop();
    // Peers may still need the last frames.
    process.hosted->links().Drain(std::chrono::seconds(1));
  }
  process.control->Close(reason);
  return exit_code;
}

}  // namespace aureole
