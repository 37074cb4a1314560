#include "server/control/run.h"

#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/grpcpp.h>

#include <memory>
#include <random>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/strings/str_join.h>
#include <absl/strings/str_split.h>

#include "server/control/interrupts.h"
#include "server/control/reconcile.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::chrono::milliseconds kPollEvery{50};
constexpr std::chrono::milliseconds kObserveEvery{100};

std::string MakeToken() {
  std::random_device random;
  return absl::StrFormat("%08x%08x%08x%08x", random(), random(), random(), random());
}

double Seconds(Clock::duration d) { return std::chrono::duration<double>(d).count(); }

absl::Status ExitError(const ServerExit& exit, const RunStatus& status) {
  std::string message = absl::StrCat("the server of region ", exit.region, " ended: ", exit.how);
  const std::string& goodbye = status.regions[exit.region].goodbye;
  if (!goodbye.empty()) absl::StrAppend(&message, "; it said: ", goodbye);
  if (!exit.log.empty()) absl::StrAppend(&message, "; its log is ", exit.log);
  if (!exit.log_tail.empty()) {
    absl::StrAppend(&message, "\n  | ", absl::StrJoin(absl::StrSplit(exit.log_tail, '\n'), "\n  | "));
  }
  return absl::AbortedError(message);
}

class Runner {
 public:
  Runner(const RunOptions& options, Allocator& allocator, const EventObserver& on_event)
      : options_(options), allocator_(allocator), on_event_(on_event) {}

  absl::Status Run(const RunObserver& observe, RunResult* result) {
    absl::Status s = Serve();
    if (s.ok()) s = Watch(observe);
    const absl::Status end = StopAll(s.ok() ? "the run is over" : std::string(s.message()));
    if (s.ok()) s = end;
    allocator_.Kill();
    if (server_ != nullptr) server_->Shutdown(std::chrono::system_clock::now() + std::chrono::seconds(1));
    if (service_ != nullptr) {
      result->status = service_->Status();
      result->hashes = service_->Hashes();
      result->violations = service_->Violations();
      result->windows.clear();
      for (size_t i = 0; i < result->status.regions.size(); ++i) {
        result->windows.push_back(service_->Windows(static_cast<RegionId>(i)));
      }
    }
    if (running_) result->wall_seconds = Seconds(ended_ - running_since_);
    return s;
  }

 private:
  // The newest server of a region.
  struct Server {
    uint64_t incarnation = 0;
    bool alive = false;
    Clock::time_point ended;
    Tick furthest = 0;            // that any server of it had reported when it ended
    int failures = 0;             // in a row, without getting further
    ServerExit exit;              // when it is not alive
    std::string storage_failure;  // as it was told of
    bool port_lost = false;       // it could not even listen
  };

  absl::Status Serve() {
    RunPlan plan;
    plan.world = options_.world;
    const int regions = options_.undivided ? 1 : options_.regions;
    for (int i = 0; i < regions; ++i) plan.tokens.push_back(MakeToken());
    plan.undivided = options_.undivided;
    plan.no_real_time = options_.no_real_time;
    plan.last_tick = options_.last_tick;
    plan.hash_every = options_.hash_every;
    plan.checkpoint_every = options_.checkpoint_every;
    service_ = std::make_unique<ControlService>(plan);
    tokens_ = plan.tokens;
    servers_.resize(static_cast<size_t>(regions));

    absl::StatusOr<std::unique_ptr<Security>> security = Security::Open(options_.security);
    if (!security.ok()) return security.status();
    security_ = *std::move(security);
    if (absl::Status s = security_->CheckListen(options_.listen, false); !s.ok()) return s;
    grpc::EnableDefaultHealthCheckService(true);
    grpc::reflection::InitProtoReflectionServerBuilderPlugin();
    grpc::ServerBuilder builder;
    int port = 0;
    builder.AddChannelArgument(GRPC_ARG_ALLOW_REUSEPORT, 0);  // else a second control plane would share the port
    security_->Listen(&builder, options_.listen, &port);
    security_->guard().Register(&builder, v1::Control::service_full_name(), service_.get());
    server_ = builder.BuildAndStart();
    if (server_ == nullptr || port == 0) {
      return absl::UnavailableError(absl::StrCat("cannot listen on ", options_.listen, "; is the port in use?"));
    }
    address_ = absl::StrCat(options_.listen.substr(0, options_.listen.rfind(':')), ":", port);
    return absl::OkStatus();
  }

  absl::Status Watch(const RunObserver& observe) {
    const auto started = Clock::now();
    auto next_observe = started;
    for (;;) {
      TakeExits();
      const RunStatus status = service_->Status();
      TellOfStorage(status);
      if (absl::Status s = Act(status); !s.ok()) return s;
      const auto now = Clock::now();
      if (status.stage >= Stage::kRunning && !running_) {
        running_ = true;
        running_since_ = now;
      }
      ended_ = now;
      if (now >= next_observe || status.stage == Stage::kFinished) {
        next_observe = now + kObserveEvery;
        if (!observe(status)) return absl::CancelledError("interrupted");
      }
      if (status.stage == Stage::kFinished) return absl::OkStatus();
      if (!running_ && now - started > options_.join_timeout) {
        return absl::DeadlineExceededError(absl::StrCat("not ready after ", options_.join_timeout.count(),
                                                        " s: ", absl::StrJoin(status.Waiting(), ", ")));
      }
      service_->Wait(kPollEvery);
    }
  }

  void TakeExits() {
    const std::vector<ServerExit> exits = allocator_.Poll();
    if (exits.empty()) return;
    const RunStatus status = service_->Status();
    for (const ServerExit& exit : exits) {
      Server& server = servers_[static_cast<size_t>(exit.region)];
      if (exit.incarnation != server.incarnation) continue;
      server.alive = false;
      server.ended = Clock::now();
      const Tick tick = status.regions[static_cast<size_t>(exit.region)].report.tick();
      server.failures = tick > server.furthest ? 0 : server.failures + 1;
      server.furthest = std::max(server.furthest, tick);
      const bool killed = absl::StartsWith(exit.how, "killed");
      server.port_lost = !killed && !status.regions[static_cast<size_t>(exit.region)].joined;
      server.exit = exit;
    }
  }

  Observed Observe(const RunStatus& status) const {
    Observed out;
    out.recovers = options_.checkpoint_every > 0;
    out.over = status.stage == Stage::kFinished;
    const auto now = Clock::now();
    for (size_t i = 0; i < servers_.size(); ++i) {
      const Server& server = servers_[i];
      const RegionStatus& r = status.regions[i];
      // Who loads a world has nothing to say.
      const bool talks = r.ready && status.stage == Stage::kRunning && !r.finished;
      out.regions.push_back({server.incarnation, server.alive, r.joined, r.joined && !r.left, r.finished,
                             server.exit.clean, talks || r.left ? Seconds(now - r.reported) : 0,
                             Seconds(now - server.ended), server.failures, server.exit.how});
    }
    return out;
  }

  absl::Status Act(const RunStatus& status) {
    const std::vector<Action> actions = Reconcile(Observe(status));
    // A server that failed says more than one that left because the run was over for it.
    const Action* worst = nullptr;
    for (const Action& a : actions) {
      if (a.kind != Action::Kind::kGiveUp) continue;
      if (worst == nullptr || !servers_[static_cast<size_t>(a.region)].exit.clean) worst = &a;
    }
    if (worst != nullptr) {
      const Server& server = servers_[static_cast<size_t>(worst->region)];
      if (!server.alive) return ExitError(server.exit, status);
      const std::string& goodbye = status.regions[static_cast<size_t>(worst->region)].goodbye;
      return absl::AbortedError(
          absl::StrCat("the server of region ", worst->region, " left: ", goodbye.empty() ? worst->why : goodbye));
    }
    for (const Action& a : actions) {
      if (a.kind == Action::Kind::kEnd) {
        Tell(a.region, absl::StrCat("incarnation ", a.incarnation, " is ended: ", a.why));
        allocator_.End(a.region, a.incarnation);
      } else if (absl::Status s = Start(a); !s.ok()) {
        return s;
      }
    }
    return absl::OkStatus();
  }

  absl::Status Start(const Action& a) {
    Server& server = servers_[static_cast<size_t>(a.region)];
    std::string token = tokens_[static_cast<size_t>(a.region)], listen;
    if (a.incarnation > 1) {
      token = MakeToken();
      service_->Expect(a.region, a.incarnation, token);
      // Clients look for it there, unless another program has taken the port.
      if (!server.port_lost) listen = service_->Status().regions[static_cast<size_t>(a.region)].endpoint;
      Tell(a.region, absl::StrCat("incarnation ", a.incarnation, " is started: ", a.why));
    }
    if (absl::Status s = allocator_.Start({a.region, a.incarnation, token, address_, listen}); !s.ok()) return s;
    server.incarnation = a.incarnation;
    server.alive = true;
    server.exit = {};
    return absl::OkStatus();
  }

  // A region that cannot write goes on; if it dies then, what it did since its last checkpoint may be lost.
  void TellOfStorage(const RunStatus& status) {
    for (size_t i = 0; i < servers_.size(); ++i) {
      const std::string& failure = status.regions[i].report.storage_failure();
      std::string& told = servers_[i].storage_failure;
      if (failure.empty() != told.empty()) {
        Tell(static_cast<RegionId>(i),
             failure.empty() ? "is protected by checkpoints again" : "is not protected by checkpoints: " + failure);
      }
      told = failure;
    }
  }

  void Tell(RegionId region, const std::string& what) const {
    if (on_event_) on_event_({std::chrono::system_clock::now(), region, what});
  }

  absl::Status StopAll(const std::string& reason) {
    if (service_ != nullptr) service_->Stop(reason);
    absl::Status result;
    const auto until = Clock::now() + options_.stop_timeout;
    while (allocator_.running() > 0 && Clock::now() < until && Interrupts() < 2) {
      for (const ServerExit& exit : allocator_.Poll()) {
        if (!exit.clean && result.ok()) result = ExitError(exit, service_->Status());
      }
      if (allocator_.running() > 0) service_->Wait(kPollEvery);
    }
    if (allocator_.running() > 0 && result.ok()) {
      result = absl::DeadlineExceededError(absl::StrCat(allocator_.running(), " servers did not end within ",
                                                        options_.stop_timeout.count(), " s of Stop and were killed"));
    }
    return result;
  }

  const RunOptions& options_;
  Allocator& allocator_;
  const EventObserver& on_event_;
  std::unique_ptr<Security> security_;
  std::unique_ptr<ControlService> service_;
  std::unique_ptr<grpc::Server> server_;  // ends before the service
  std::string address_;
  std::vector<std::string> tokens_;  // of the first servers
  std::vector<Server> servers_;      // by region
  bool running_ = false;
  Clock::time_point running_since_, ended_;
};

}  // namespace

absl::Status RunWorld(const RunOptions& options, Allocator& allocator, const RunObserver& observe, RunResult* result,
                      const EventObserver& on_event) {
  return Runner(options, allocator, on_event).Run(observe, result);
}

}  // namespace aureole
