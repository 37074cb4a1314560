#include "server/control/run.h"

#include <grpcpp/grpcpp.h>

#include <memory>
#include <optional>
#include <random>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/strings/str_join.h>
#include <absl/strings/str_split.h>

#include "server/control/control_plane_service.h"
#include "server/control/control_port.h"
#include "server/control/interrupts.h"
#include "server/control/layout_run.h"
#include "server/control/reconcile.h"
#include "server/control/scaling_run.h"
#include "server/transport/world_spec.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::chrono::milliseconds kPollEvery{50};
constexpr std::chrono::milliseconds kObserveEvery{100};
constexpr std::chrono::milliseconds kStartDelay{300};  // from the last Ready to tick 0

std::string MakeToken() {
  std::random_device random;
  return absl::StrFormat("%08x%08x%08x%08x", random(), random(), random(), random());
}

int64_t UnixUs(std::chrono::system_clock::time_point t) {
  return std::chrono::duration_cast<std::chrono::microseconds>(t.time_since_epoch()).count();
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
    absl::Status s = Prepare();
    if (s.ok()) s = Serve();
    if (s.ok()) s = Watch(observe);
    if (leaves_) {
      allocator_.Release();
    } else {
      const absl::Status end = StopAll(s.ok() ? "the run is over" : std::string(s.message()));
      if (s.ok()) s = end;
      allocator_.Kill();
    }
    if (options_.hub != nullptr) options_.hub->Remove(options_.world_name);
    if (service_ != nullptr) service_->Close();
    events().End();
    if (checkpoints_ != nullptr) checkpoints_->Close();
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
    bool adopted = false;  // an earlier control plane has started it
    bool joins = false;    // none was started since the region was given its name
    bool wanted = true;
    Clock::time_point ended;
    Tick furthest = 0;                                   // that any server of it had reported when it ended
    int failures = 0;                                    // in a row, without getting further
    ServerExit exit;                                     // when it is not alive
    std::string storage_failure, copy_failure, fetched;  // as was told of
    bool port_lost = false;                              // it could not even listen
  };

  // What an earlier control plane has left.
  absl::Status Prepare() {
    const int regions = options_.undivided ? 1 : options_.regions;
    servers_.resize(static_cast<size_t>(regions));
    plan_regions_.resize(servers_.size());
    const auto now = Clock::now();
    for (Server& server : servers_) server.ended = now;
    layout_ = std::make_unique<LayoutRun>(
        options_.layouts, regions,
        [this](EventKind kind, RegionId r, const std::string& what) { Tell(kind, r, what); });
    if (options_.scaling.on()) {
      scaling_.emplace(options_.scaling, options_.layouts,
                       [this](const std::string& what) { Tell(v1::ControlEvent::SCALED, kNoRegion, what); });
    }
    record_.set_world_hash(WorldHash(options_.world));
    for (int i = 0; i < regions; ++i) record_.add_regions();
    if (options_.store == nullptr) return absl::OkStatus();
    leaves_ = true;  // whatever runs must not suffer from what is found
    absl::StatusOr<std::optional<v1::WorldRecord>> found = options_.store->Load();
    if (!found.ok()) return found.status();
    if (found->has_value()) {
      if ((*found)->world_hash() != record_.world_hash() || (*found)->regions_size() < regions) {
        return absl::FailedPreconditionError(
            "the store has another world, which may still run; take another store, or the world that it was made for");
      }
      record_ = **std::move(found);
    }
    if (absl::Status s = layout_->Restore(record_); !s.ok()) return s;
    const auto known = static_cast<size_t>(record_.regions_size());
    servers_.resize(known);
    plan_regions_.resize(known);
    for (Server& server : servers_) server.ended = now;
    absl::StatusOr<std::vector<ServerStart>> adopted = allocator_.Adopt();
    if (!adopted.ok()) return adopted.status();
    leaves_ = false;
    for (size_t i = 0; i < servers_.size(); ++i) {
      const v1::RegionRecord& from = record_.regions(static_cast<int>(i));
      servers_[i].incarnation = from.incarnation();
      servers_[i].exit.how = "it has ended while no control plane was there";
      plan_regions_[i].incarnation = std::max<uint64_t>(1, from.incarnation());
      plan_regions_[i].was_ready = from.was_ready();
      plan_regions_[i].ready_incarnation = from.ready_incarnation();
      plan_regions_[i].keeper = from.keeper();
      plan_regions_[i].endpoint = from.endpoint();
      const auto r = static_cast<RegionId>(i);
      servers_[i].wanted = layout_->WantsServer(r);
      plan_regions_[i].member = layout_->IsMember(r);
      plan_regions_[i].retired = !servers_[i].wanted;
      if (from.has_joins()) plan_regions_[i].joins = from.joins();
    }
    for (const ServerStart& server : *adopted) {
      const auto i = static_cast<size_t>(server.region);
      if (server.region < 0 || i >= servers_.size() || !servers_[i].wanted ||
          server.incarnation != servers_[i].incarnation) {
        allocator_.End(server.region, server.incarnation);
        continue;
      }
      servers_[i].alive = servers_[i].adopted = true;
      plan_regions_[i].token = server.token;
    }
    return absl::OkStatus();
  }

  absl::Status Serve() {
    RunPlan plan;
    plan.world = options_.world;
    plan.regions = plan_regions_;
    plan.control_epoch = options_.control_epoch;
    plan.layout_epoch = layout_->epoch();
    plan.start_unix_us = record_.start_unix_us();
    plan.undivided = options_.undivided;
    plan.no_real_time = options_.no_real_time;
    plan.last_tick = options_.last_tick;
    plan.hash_every = options_.hash_every;
    plan.checkpoint_every = options_.checkpoint_every;
    service_ = std::make_unique<ControlService>(plan);
    layout_->Serve(service_.get());
    if (options_.layouts != nullptr) {
      checkpoints_ =
          std::make_unique<CheckpointDesk>(options_.checkpoint_every, options_.layouts->world().environment.tick_us);
      operators_ = std::make_unique<ControlPlaneService>(*options_.layouts, events(), *checkpoints_,
                                                         [service = service_.get()] { return service->Status(); });
    }
    if (options_.hub != nullptr) {
      options_.hub->Add(options_.world_name, {service_.get(), operators_.get(),
                                              options_.layouts == nullptr ? "" : options_.layouts->world().name});
      address_ = options_.advertise;
      return absl::OkStatus();
    }
    absl::StatusOr<std::unique_ptr<Security>> security = Security::Open(options_.security);
    if (!security.ok()) return security.status();
    security_ = *std::move(security);
    if (absl::Status s = security_->CheckListen(options_.listen, operators_ != nullptr); !s.ok()) return s;
    grpc::ServerBuilder builder;
    ConfigureControlPort(&builder);
    int port = 0;
    // Servers that run look for it where it was.
    const bool any = absl::EndsWith(options_.listen, ":0") && !record_.control().empty();
    const std::string listen = any ? record_.control() : options_.listen;
    security_->Listen(&builder, listen, &port);
    security_->guard().Register(&builder, v1::Control::service_full_name(), service_.get());
    if (operators_ != nullptr) {
      security_->guard().Register(&builder, v1::ControlPlane::service_full_name(), operators_.get());
      security_->guard().ServeWorld(options_.layouts->world().name);
    }
    server_ = builder.BuildAndStart();
    if (server_ == nullptr || port == 0) {
      leaves_ = options_.store != nullptr;
      return absl::UnavailableError(absl::StrCat("cannot listen on ", listen, "; is the port in use?"));
    }
    address_ = absl::StrCat(listen.substr(0, listen.rfind(':')), ":", port);
    record_.set_control(address_);
    return absl::OkStatus();
  }

  absl::Status Watch(const RunObserver& observe) {
    const auto started = Clock::now();
    auto next_observe = started;
    for (;;) {
      if (options_.leave != nullptr && *options_.leave) {
        leaves_ = true;
        return absl::CancelledError("left; the servers go on");
      }
      TakeExits();
      layout_->Step(service_->Status());
      FollowLayout();
      RunStatus status = service_->Status();
      status.control = address_;
      TellOfStorage(status);
      if (scaling_.has_value()) scaling_->Step(status);
      if (checkpoints_ != nullptr) {
        checkpoints_->Step(status, [this](RegionId r, Tick tick) { service_->SaveCheckpoint(r, tick); });
      }
      if (absl::Status s = Keep(status); !s.ok()) return s;
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

  // Servers of regions that have a new name, or one that was free.
  void FollowLayout() {
    const auto regions = static_cast<size_t>(layout_->regions());
    for (size_t i = 0; i < regions; ++i) {
      const bool wanted = layout_->WantsServer(static_cast<RegionId>(i));
      if (i == servers_.size()) {
        servers_.emplace_back();
        record_.add_regions();
        servers_[i].wanted = false;
      }
      if (wanted && !servers_[i].wanted) {
        const uint64_t last = servers_[i].incarnation;
        servers_[i] = {};
        servers_[i].incarnation = last;
        servers_[i].joins = true;
      }
      const bool given_up = servers_[i].wanted && !wanted && !servers_[i].alive;
      servers_[i].wanted = wanted;
      if (given_up) layout_->Ended(static_cast<RegionId>(i), true);
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
      // What it said last counts: its Pod may be gone before anybody saw how it ended, and one that was told to end may
      // have ended in order before the others could do without it.
      const RegionStatus& last = status.regions[static_cast<size_t>(exit.region)];
      if (layout_->Leaves(exit.region) && last.leaves_by.has_value()) server.exit.clean = false;
      server.exit.clean |= last.gone;
      layout_->Ended(exit.region, server.exit.clean);
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
      const bool joins = server.adopted && !r.joined;
      out.regions.push_back({server.incarnation, server.alive, r.joined, r.joined && !r.left, r.finished,
                             server.exit.clean, talks || joins || r.left ? Seconds(now - r.reported) : 0,
                             Seconds(now - server.ended), server.failures, server.exit.how, server.adopted,
                             server.wanted, layout_->Leaves(static_cast<RegionId>(i)), server.joins,
                             layout_->IsMember(static_cast<RegionId>(i))});
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
        Tell(v1::ControlEvent::REGION_ENDED, a.region,
             absl::StrCat("incarnation ", a.incarnation, " is ended: ", a.why));
        allocator_.End(a.region, a.incarnation);
      } else if (absl::Status s = Start(a); !s.ok()) {
        return s;
      }
    }
    return absl::OkStatus();
  }

  absl::Status Start(const Action& a) {
    Server& server = servers_[static_cast<size_t>(a.region)];
    const std::string token = MakeToken();
    std::string listen;
    service_->Expect(a.region, a.incarnation, token);
    // Before it is started: no two servers may ever have one incarnation.
    record_.mutable_regions(a.region)->set_incarnation(a.incarnation);
    if (absl::Status s = Save(); !s.ok()) return s;
    if (a.incarnation > 1) {
      // Clients look for it there, unless another program has taken the port.
      if (!server.port_lost) listen = service_->Status().regions[static_cast<size_t>(a.region)].endpoint;
      Tell(server.joins ? v1::ControlEvent::REGION_STARTED : v1::ControlEvent::REGION_REPLACED, a.region,
           absl::StrCat("incarnation ", a.incarnation, " is started: ", a.why));
    }
    if (absl::Status s = allocator_.Start({a.region, a.incarnation, token, address_, listen}); !s.ok()) return s;
    server.incarnation = a.incarnation;
    server.alive = true;
    server.adopted = server.joins = false;
    server.exit = {};
    return absl::OkStatus();
  }

  // What the next control plane must know, before anything depends on it.
  absl::Status Keep(const RunStatus& status) {
    bool changed = layout_->Keep(&record_);
    for (size_t i = 0; i < servers_.size(); ++i) {
      v1::RegionRecord* const to = record_.mutable_regions(static_cast<int>(i));
      const RegionStatus& from = status.regions[i];
      changed |= to->was_ready() != from.was_ready || to->endpoint() != from.endpoint ||
                 to->ready_incarnation() != from.ready_incarnation || to->keeper() != from.keeper;
      to->set_was_ready(from.was_ready);
      to->set_ready_incarnation(from.ready_incarnation);
      to->set_keeper(from.keeper);
      to->set_endpoint(from.endpoint);
    }
    const bool starts = status.stage == Stage::kReady;
    int64_t start = status.start_unix_us;
    if (starts) start = UnixUs(std::chrono::system_clock::now() + kStartDelay);
    changed |= record_.start_unix_us() != start;
    record_.set_start_unix_us(start);
    if (changed) {
      if (absl::Status s = Save(); !s.ok()) return s;
    }
    if (starts) service_->StartAll(start);
    return absl::OkStatus();
  }

  absl::Status Save() {
    if (options_.store == nullptr) return absl::OkStatus();
    absl::Status s = options_.store->Save(record_);
    // Without the store this control plane must not act any more; another one may.
    if (!s.ok()) leaves_ = true;
    return s;
  }

  // A region that cannot write goes on; if it dies then, what it did since its last checkpoint may be lost. One without
  // a copy must not lose its volume.
  void TellOfStorage(const RunStatus& status) {
    for (size_t i = 0; i < servers_.size(); ++i) {
      const auto region = static_cast<RegionId>(i);
      const RegionStatus& r = status.regions[i];
      TellOfFailure(region, "checkpoints", r.report.storage_failure(), &servers_[i].storage_failure,
                    v1::ControlEvent::STORAGE_FAILED, v1::ControlEvent::STORAGE_RECOVERED);
      TellOfFailure(region, "a copy", r.report.copy_failure(), &servers_[i].copy_failure, v1::ControlEvent::COPY_LOST,
                    v1::ControlEvent::COPY_RECOVERED);
      if (r.fetched != servers_[i].fetched && !r.fetched.empty()) {
        Tell(v1::ControlEvent::COPY_FETCHED, region, "goes on from " + r.fetched);
      }
      servers_[i].fetched = r.fetched;
    }
  }

  void TellOfFailure(RegionId region, const char* by, const std::string& failure, std::string* told, EventKind failed,
                     EventKind recovered) {
    if (failure.empty() != told->empty()) {
      Tell(failure.empty() ? recovered : failed, region,
           failure.empty() ? absl::StrCat("is protected by ", by, " again")
                           : absl::StrCat("is not protected by ", by, ": ", failure));
    }
    *told = failure;
  }

  EventLog& events() { return options_.events != nullptr ? *options_.events : own_events_; }

  void Tell(EventKind kind, RegionId region, const std::string& what) {
    const RunEvent event = events().Add({std::chrono::system_clock::now(), kind, region, what});
    if (on_event_) on_event_(event);
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
  EventLog own_events_;
  std::unique_ptr<Security> security_;
  std::unique_ptr<ControlService> service_;
  std::unique_ptr<CheckpointDesk> checkpoints_;
  std::unique_ptr<ControlPlaneService> operators_;
  std::unique_ptr<grpc::Server> server_;  // ends before the services
  std::unique_ptr<LayoutRun> layout_;
  std::optional<ScalingRun> scaling_;
  std::string address_;
  v1::WorldRecord record_;
  std::vector<RunPlan::Region> plan_regions_;
  std::vector<Server> servers_;  // by region
  bool leaves_ = false;          // the servers go on without this control plane
  bool running_ = false;
  Clock::time_point running_since_, ended_;
};

}  // namespace

absl::Status RunWorld(const RunOptions& options, Allocator& allocator, const RunObserver& observe, RunResult* result,
                      const EventObserver& on_event) {
  return Runner(options, allocator, on_event).Run(observe, result);
}

}  // namespace aureole
