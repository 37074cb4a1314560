#include "server/control/run.h"

#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/grpcpp.h>

#include <memory>
#include <random>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/strings/str_join.h>
#include <absl/strings/str_split.h>

#include "server/control/interrupts.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::chrono::milliseconds kPollEvery{50};
constexpr std::chrono::milliseconds kObserveEvery{100};
// A server whose stream has ended has this long to end too, so that its own exit can be the message.
constexpr std::chrono::seconds kExitAfterLeave{3};

std::string MakeToken() {
  std::random_device random;
  return absl::StrFormat("%08x%08x%08x%08x", random(), random(), random(), random());
}

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

// A server that failed says more than one that left because the run was over for it.
absl::Status FirstError(const std::vector<ServerExit>& exits, const RunStatus& status, bool clean_is_error) {
  for (const ServerExit& exit : exits) {
    if (!exit.clean) return ExitError(exit, status);
  }
  return clean_is_error && !exits.empty() ? ExitError(exits.front(), status) : absl::OkStatus();
}

class Runner {
 public:
  Runner(const RunOptions& options, Allocator& allocator) : options_(options), allocator_(allocator) {}

  absl::Status Run(const RunObserver& observe, RunResult* result) {
    absl::Status s = StartAll();
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
    if (running_) result->wall_seconds = std::chrono::duration<double>(ended_ - running_since_).count();
    return s;
  }

 private:
  absl::Status StartAll() {
    RunPlan plan;
    plan.world = options_.world;
    const int regions = options_.undivided ? 1 : options_.regions;
    for (int i = 0; i < regions; ++i) plan.tokens.push_back(MakeToken());
    plan.undivided = options_.undivided;
    plan.no_real_time = options_.no_real_time;
    plan.last_tick = options_.last_tick;
    plan.hash_every = options_.hash_every;
    service_ = std::make_unique<ControlService>(plan);

    grpc::EnableDefaultHealthCheckService(true);
    grpc::reflection::InitProtoReflectionServerBuilderPlugin();
    grpc::ServerBuilder builder;
    int port = 0;
    builder.AddChannelArgument(GRPC_ARG_ALLOW_REUSEPORT, 0);  // else a second control plane would share the port
    builder.AddListeningPort(options_.listen, grpc::InsecureServerCredentials(), &port);
    builder.RegisterService(service_.get());
    server_ = builder.BuildAndStart();
    if (server_ == nullptr || port == 0) {
      return absl::UnavailableError(absl::StrCat("cannot listen on ", options_.listen, "; is the port in use?"));
    }
    const std::string host = options_.listen.substr(0, options_.listen.rfind(':'));
    for (int i = 0; i < regions; ++i) {
      const absl::Status s = allocator_.Start({i, plan.tokens[i], absl::StrCat(host, ":", port)});
      if (!s.ok()) return s;
    }
    return absl::OkStatus();
  }

  absl::Status Watch(const RunObserver& observe) {
    const auto started = Clock::now();
    auto next_observe = started;
    for (;;) {
      const std::vector<ServerExit> exits = allocator_.Poll();
      const RunStatus status = service_->Status();
      if (absl::Status s = FirstError(exits, status, true); !s.ok()) return s;
      if (absl::Status s = CheckLeft(status); !s.ok()) return s;
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

  absl::Status CheckLeft(const RunStatus& status) {
    for (size_t i = 0; i < status.regions.size(); ++i) {
      const RegionStatus& r = status.regions[i];
      if (!r.left) continue;
      std::vector<ServerExit> exits;
      for (const auto until = Clock::now() + kExitAfterLeave; Clock::now() < until && exits.empty();) {
        exits = allocator_.Poll();
        if (exits.empty()) service_->Wait(kPollEvery);
      }
      if (absl::Status s = FirstError(exits, status, r.goodbye.empty()); !s.ok()) return s;
      return absl::AbortedError(
          absl::StrCat("the server of region ", i, " left: ", r.goodbye.empty() ? "its stream ended" : r.goodbye));
    }
    return absl::OkStatus();
  }

  absl::Status StopAll(const std::string& reason) {
    if (service_ != nullptr) service_->Stop(reason);
    absl::Status result;
    const auto until = Clock::now() + options_.stop_timeout;
    while (allocator_.running() > 0 && Clock::now() < until && Interrupts() < 2) {
      if (absl::Status s = FirstError(allocator_.Poll(), service_->Status(), false); !s.ok() && result.ok()) result = s;
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
  std::unique_ptr<ControlService> service_;
  std::unique_ptr<grpc::Server> server_;  // ends before the service
  bool running_ = false;
  Clock::time_point running_since_, ended_;
};

}  // namespace

absl::Status RunWorld(const RunOptions& options, Allocator& allocator, const RunObserver& observe, RunResult* result) {
  return Runner(options, allocator).Run(observe, result);
}

}  // namespace aureole
