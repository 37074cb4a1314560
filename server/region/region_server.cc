#include "server/region/region_server.h"

#include <pthread.h>
#include <signal.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <filesystem>
#include <memory>
#include <mutex>
#include <optional>
#include <thread>
#include <utility>

#include <absl/strings/str_cat.h>
#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/health_check_service_interface.h>
#include <grpcpp/server.h>
#include <grpcpp/server_builder.h>
#include <spdlog/spdlog.h>

#include "server/region/control_stream.h"
#include "server/region/copy_keeper.h"
#include "server/region/hosted_region.h"
#include "server/region/metrics.h"
#include "server/transport/peer_service.h"
#include "server/transport/recording_service.h"
#include "server/transport/simulation_service.h"
#include "server/transport/world_spec.h"

namespace aureole {
namespace {

constexpr uint32_t kControlProtocolVersion = 1;
// Leaving takes milliseconds. A process that is stuck in it is ended by the kernel, so that none is left behind.
constexpr unsigned kLongestLeaveSeconds = 10;
// Who has nothing to do yet does not wait longer than this for a control plane; the wait between two tries.
constexpr std::chrono::seconds kLongestJoin{60};
constexpr std::chrono::milliseconds kJoinAgainAfter{300};
// Who was told to end waits so long for a control plane that says what becomes of its region.
constexpr std::chrono::seconds kLongestAnswer{10};

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
  std::unique_ptr<CopyKeeper> copies;
  std::unique_ptr<GrpcServer> server;
  std::string control_address, world;
  v1::Hello hello;
  std::unique_ptr<ControlChannel> channel;  // of the stream
  std::mutex control_mutex;  // guards what follows, but not its use by the main thread, which alone changes it
  std::unique_ptr<ControlStream> control;
  std::optional<v1::Report> last_report;  // of a run that is over
  std::unique_ptr<HostedRegion> hosted;
  uint64_t told_epoch = 0;               // of the layout that clients know; of the tick thread
  std::atomic<bool> peer_moved = false;  // since they were told of it
  uint64_t control_epoch = 0;            // the highest that was heard
  bool control_lost = false;
  int64_t start_unix_us = 0;  // 0: not started
  std::chrono::steady_clock::time_point join_again = std::chrono::steady_clock::time_point::max();
  std::chrono::steady_clock::time_point give_up_joining;
  std::chrono::milliseconds leave_within{};
  // Once it was told to end: when it does, if its region has not left before.
  std::optional<std::chrono::steady_clock::time_point> leaves_by;
  std::chrono::steady_clock::time_point ends = std::chrono::steady_clock::time_point::max();

  TickLoop::Hooks Hooks();
  void FollowLayout(const Region& region);
  absl::Status Handle(const v1::ToRegion& message);
  void Join();
  bool Report(const v1::Report& report);
  void SayLastReport();
  bool AskToLeave();
  void SayLeaving();
};

// Opens a stream, with what this server runs.
void Process::Join() {
  join_again = std::chrono::steady_clock::time_point::max();
  if (hosted != nullptr) {
    v1::Running* running = hello.mutable_running();
    running->set_region(hosted->assignment().region());
    running->set_incarnation(hosted->assignment().incarnation());
    running->set_world_hash(WorldHash(hosted->assignment().world()));
    running->set_start_unix_us(start_unix_us);
    const HostedRegion::Progress progress = hosted->progress();
    running->set_tick(progress.tick);
    running->set_bodies(progress.bodies);
    hosted->SayAgain();
  }
  // The address may be that of whichever control plane leads: a connection that leads to another one stays with it.
  channel = std::make_unique<ControlChannel>(control_address, security->channel(), world);
  auto stream = std::make_unique<ControlStream>(channel.get(), hello, &events);
  const std::lock_guard lock(control_mutex);
  control = std::move(stream);
  if (last_report.has_value()) SayLastReport();
  if (leaves_by.has_value()) SayLeaving();
}

// The world goes on meanwhile; false: there is none that does, or it has asked already.
bool Process::AskToLeave() {
  if (leaves_by.has_value() || start_unix_us == 0 || leave_within.count() == 0) return false;
  const std::lock_guard lock(control_mutex);
  if (last_report.has_value()) return false;
  const auto now = std::chrono::steady_clock::now();
  leaves_by = now + leave_within;
  ends = std::min(*leaves_by, now + kLongestAnswer);
  server->SetServing(false);
  SayLeaving();
  return true;
}

// With the mutex.
void Process::SayLeaving() {
  const auto left = *leaves_by - std::chrono::steady_clock::now();
  v1::FromRegion message;
  message.mutable_leaving()->set_within_ms(std::chrono::duration_cast<std::chrono::milliseconds>(left).count());
  control->Send(std::move(message));
}

// With the mutex.
void Process::SayLastReport() {
  v1::FromRegion message;
  *message.mutable_report() = *last_report;
  control->Send(std::move(message));
}

// The tick thread; false: nobody has heard it.
bool Process::Report(const v1::Report& report) {
  v1::FromRegion message;
  *message.mutable_report() = report;
  const std::lock_guard lock(control_mutex);
  return control->Send(std::move(message));
}

v1::FromRegion LayoutOutcomeOf(const InputOutcome& outcome) {
  v1::FromRegion message;
  v1::LayoutOutcome* out = message.mutable_layout_outcome();
  out->set_sequence(outcome.name.second);
  out->set_tick(outcome.tick);
  out->set_refused(outcome.refused);
  return message;
}

// The tick thread. Clients hear of a layout that has just come into force, and of servers that are elsewhere; those of
// a region that has left have to say elsewhere what has not acted yet.
void Process::FollowLayout(const Region& region) {
  if (region.phase() == Phase::kLeft) simulation.Leave();
  const bool moved = peer_moved.exchange(false);
  if (region.layout_epoch() == told_epoch && !moved) return;
  told_epoch = region.layout_epoch();
  std::vector<std::string> endpoints = hosted->links().Endpoints();
  const auto self = static_cast<size_t>(region.self());
  endpoints.resize(std::max(endpoints.size(), self + 1));
  endpoints[self] = server->endpoint();
  simulation.Follow(region, endpoints);
}

TickLoop::Hooks Process::Hooks() {
  TickLoop::Hooks hooks;
  hooks.after_tick = [this](const FrameSample& sample) {
    if (metrics != nullptr) metrics->AddTick(sample);
  };
  hooks.inputs = [this] { return simulation.inputs().Take(); };
  hooks.outcomes = [this](const std::vector<InputOutcome>& outcomes) {
    simulation.inputs().Settle(outcomes);
    for (const InputOutcome& outcome : outcomes) {
      if (outcome.name.first != kControlSource) continue;
      const std::lock_guard lock(control_mutex);
      control->Send(LayoutOutcomeOf(outcome));
    }
  };
  hooks.publish = [this](Region* region, int64_t bodies, const std::vector<Input>& delivered) {
    simulation.inputs().Hear(delivered);
    FollowLayout(*region);
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
    return Report(report);
  };
  hooks.epilogue = [this](const v1::Report& report, bool heard) {
    const std::lock_guard lock(control_mutex);
    last_report = report;
    if (!heard) SayLastReport();  // a new stream may have come since
  };
  hooks.fenced = [this] {
    Event event;
    event.kind = Event::Kind::kFenced;
    events.Push(std::move(event));
  };
  hooks.log = [](const std::string& what) { spdlog::warn("{}", what); };
  hooks.gone = [this] {
    Event event;
    event.kind = Event::Kind::kGone;
    events.Push(std::move(event));
  };
  return hooks;
}

absl::Status Process::Handle(const v1::ToRegion& message) {
  if (message.control_epoch() < control_epoch) {
    spdlog::warn("a control plane of epoch {} speaks after one of epoch {}: not obeyed", message.control_epoch(),
                 control_epoch);
    control->Cancel();  // its end is heard of, and another stream is opened
    return absl::OkStatus();
  }
  control_epoch = message.control_epoch();
  if (std::exchange(control_lost, false)) spdlog::info("a control plane of epoch {} is there", control_epoch);
  if (message.has_assignment()) {
    if (hosted != nullptr) return absl::FailedPreconditionError("a second assignment");
    const v1::Assignment& assignment = message.assignment();
    for (const std::string& peer : assignment.endpoints()) {
      if (peer.empty()) continue;
      if (absl::Status s = security->CheckDial(peer); !s.ok()) return s;
    }
    absl::StatusOr<std::unique_ptr<HostedRegion>> loaded = HostedRegion::Load(assignment, data, security->channel());
    if (!loaded.ok()) return loaded.status();
    hosted = *std::move(loaded);
    spdlog::info("region {} of {}, world {}, {} bodies, k = {}, tick {} us, layout epoch {}, last tick {}, {}",
                 assignment.region(), assignment.endpoints_size(), hosted->world().name,
                 hosted->region().engine().Counts().bodies, hosted->world().exchange.k,
                 hosted->world().environment.tick_us, assignment.layout_epoch(), assignment.last_tick(),
                 assignment.no_real_time() ? "as fast as it can" : "in real time");
    if (metrics != nullptr) metrics->Assigned(hosted->world().name, assignment.region());
    security->guard().ServeWorld(hosted->world().name);
    copies->Serve(WorldHash(assignment.world()), assignment.region());
    hosted->Connect(&peers, security->channel());
    v1::FromRegion ready;
    ready.mutable_ready()->set_bodies(hosted->region().engine().Counts().bodies);
    ready.mutable_ready()->set_tick(hosted->region().tick());
    ready.mutable_ready()->set_fetched(hosted->fetched());
    control->Send(std::move(ready));
  } else if (message.has_start()) {
    if (hosted == nullptr) return absl::FailedPreconditionError("a start without an assignment");
    if (start_unix_us != 0) return absl::OkStatus();  // said again to who has joined again
    start_unix_us = message.start().start_unix_us();
    simulation.Serve(hosted->assignment(), hosted->world());
    recording.Serve(hosted->assignment().region(), hosted->assignment().world(), hosted->world().exchange.k == 0);
    hosted->Start(start_unix_us, Hooks());
    server->SetServing(true);
  } else if (message.has_peer_moved()) {
    if (hosted == nullptr) return absl::FailedPreconditionError("a peer has moved before the assignment");
    if (absl::Status s = security->CheckDial(message.peer_moved().endpoint()); !s.ok()) return s;
    spdlog::info("region {} is incarnation {} now, at {}", message.peer_moved().region(),
                 message.peer_moved().incarnation(), message.peer_moved().endpoint());
    hosted->PeerMoved(message.peer_moved());
    peer_moved = true;
  } else if (message.has_peer_left()) {
    if (hosted == nullptr) return absl::FailedPreconditionError("a peer has left before the assignment");
    spdlog::info("region {} has left", message.peer_left().region());
    hosted->PeerLeft(message.peer_left());
  } else if (message.has_change_layout()) {
    if (hosted == nullptr) return absl::FailedPreconditionError("a change of the layout before the assignment");
    return hosted->ChangeLayout(message.change_layout());
  } else if (message.has_save_checkpoint()) {
    if (hosted == nullptr) return absl::FailedPreconditionError("a checkpoint is asked for before the assignment");
    hosted->SaveAt(message.save_checkpoint().tick());
  }
  return absl::OkStatus();
}

// What runs goes on without a control plane, unless it is one that will not have this server.
bool ControlLost(Process* process, const Event& event, int* exit_code, std::string* reason) {
  const auto now = std::chrono::steady_clock::now();
  if (event.refused || (process->hosted == nullptr && now > process->give_up_joining)) {
    *reason = "control plane lost: " + event.reason;
    *exit_code = 1;
    return false;
  }
  const auto level = std::exchange(process->control_lost, true) ? spdlog::level::debug : spdlog::level::warn;
  spdlog::log(level, "control plane lost: {}; {} and joins again", event.reason,
              process->hosted == nullptr ? "waits" : "goes on");
  process->join_again = now + kJoinAgainAfter;
  return true;
}

// True when the process should go on.
bool HandleEvent(Process* process, const Event& event, int* exit_code, std::string* reason, bool* left) {
  switch (event.kind) {
    case Event::Kind::kSignal:
      if (event.signal == SIGUSR1) {
        spdlog::warn("SIGUSR1: cutting every link");
        if (process->hosted != nullptr) process->hosted->links().CutAll();
        return true;
      }
      *reason = strsignal(event.signal);
      if (event.signal != SIGTERM || !process->AskToLeave()) return false;
      spdlog::info("{}: asks to leave the world", *reason);
      return true;
    case Event::Kind::kControlLost:
      return ControlLost(process, event, exit_code, reason);
    case Event::Kind::kFenced:
      *reason = "fenced: a later incarnation has taken over the checkpoints";
      *exit_code = 1;
      return false;
    case Event::Kind::kGone:
      *reason = "the region has left its world";
      *left = true;
      return false;
    case Event::Kind::kMessage:
      break;
  }
  if (event.message.has_stop()) {
    *reason = "stopped: " + event.message.stop().reason();
    return false;
  }
  if (event.message.has_leaving_answer() && process->leaves_by.has_value()) {
    const std::string& refused = event.message.leaving_answer().refused();
    *reason = "told to end, and cannot leave before: " + refused;
    process->ends = *process->leaves_by;
    return refused.empty();
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
  process.copies =
      std::make_unique<CopyKeeper>(options.data.empty() ? "" : std::filesystem::path(options.data) / "copies");
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
                                       {v1::Copies::service_full_name(), process.copies.get()},
                                       {v1::Simulation::service_full_name(), &process.simulation},
                                       {v1::Recording::service_full_name(), &process.recording}});
  if (process.server == nullptr) {
    spdlog::error("--listen: cannot listen on {}; choose another host:port, or port 0", options.listen);
    return 1;
  }
  v1::Hello& hello = process.hello;
  hello.set_protocol_version(kControlProtocolVersion);
  hello.set_token(options.token);
  hello.set_endpoint(process.server->endpoint());
  hello.set_metrics_endpoint(process.metrics != nullptr ? process.metrics->endpoint() : "");
  hello.set_pid(getpid());
  spdlog::info("aureole-region: pid {}, control {}, peers and clients {}, metrics {}", getpid(), options.control,
               process.server->endpoint(), process.metrics != nullptr ? process.metrics->endpoint() : "off");
  process.control_address = options.control;
  process.world = options.world;
  process.leave_within = options.leave_within;
  process.give_up_joining = std::chrono::steady_clock::now() + kLongestJoin;
  process.Join();

  int exit_code = 0;
  std::string reason;
  bool left = false;
  for (bool goes_on = true; goes_on;) {
    Event event;
    if (process.events.PopUntil(std::min(process.join_again, process.ends), &event)) {
      goes_on = HandleEvent(&process, event, &exit_code, &reason, &left);
    } else if (std::chrono::steady_clock::now() >= process.ends) {
      reason = "told to end, and has not left in time";
      goes_on = false;
    } else {
      process.Join();
    }
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
  process.control->Close(reason, left);
  return exit_code;
}

}  // namespace aureole
