// Runs one World for as long as it is there: reads it, runs it in Pods, says in its status and events what happens, and
// tries again what has failed.
#pragma once

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <optional>
#include <string>
#include <thread>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/control/control_hub.h"
#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/event_recorder.h"
#include "server/control/kubernetes/object_cache.h"
#include "server/control/kubernetes/pod_allocator.h"
#include "server/control/kubernetes/status_store.h"
#include "server/control/kubernetes/world_resource.h"
#include "server/control/run.h"

namespace aureole::kubernetes {

// What all Worlds of a control plane that leads have in common. The pointers outlive all runners.
struct RunnerContext {
  ApiClient* client = nullptr;
  ControlHub* hub = nullptr;
  EventRecorder* events = nullptr;
  std::string advertise;  // where servers dial, host:port
  PodDefaults defaults;
  int64_t epoch = 1;
  std::function<bool()> leads = [] { return true; };
  std::function<void(const std::string&)> log = [](const std::string&) {};  // any thread
  // Once it is true, runners end and the servers go on.
  const std::atomic<bool>* leave = nullptr;
  PodAllocator::Options pods = {};   // its times
  StatusStore::Options status = {};  // likewise
  std::chrono::seconds join_timeout{600};
  std::chrono::milliseconds first_retry{10000}, longest_retry{300000};  // after a run that failed
};

class WorldRunner {
 public:
  // Starts a thread.
  WorldRunner(const RunnerContext* context, Object world);
  // Waits for the end of the thread: Stop or leave before.
  ~WorldRunner();
  WorldRunner(const WorldRunner&) = delete;
  WorldRunner& operator=(const WorldRunner&) = delete;

  const std::string& uid() const { return uid_; }
  // These return at once; any thread. The World as it is now: cheap when it is the same.
  void Update(Object world);
  // The World is deleted: its servers stop in order, then it is done.
  void Stop();
  // With context.leave: nothing waits for the API server any more.
  void Hurry() { store_.Close(); }
  bool done() const { return done_; }

 private:
  using Clock = std::chrono::steady_clock;
  enum class Next : uint8_t { kSoon, kLater, kOnChange };  // when to try again

  void Run();
  Next Try(const Json& object);
  Next RunOnce(WorldResource world);
  PodAllocator::Options PodOptions(const PodTemplate& pods) const;
  // The text that the World's worldFrom points to; nothing when it is not there, or there is no worldFrom.
  absl::StatusOr<std::optional<std::string>> ReadSource(const Json& object);
  Next Refuse(int64_t generation, const std::string& phase, const std::string& reason, const std::string& message);
  // All servers of a world have to run one binary: where the World names none it is the one that the world began with,
  // and not that of a control plane which was upgraded since. Nothing when `image` is empty.
  void Pin(const std::string& image, const std::string& pull_policy);
  // Takes over what may change of a world that runs; else says what may not.
  std::string Change(const Json& object, WorldResource* world);
  void Tell(bool warning, const std::string& reason, const std::string& message);
  void TellRefused(const std::string& why);  // uses nothing that is declared after the store
  bool ends() const { return stopping_ || *context_->leave; }
  Object Latest() const;

  const RunnerContext* const context_;
  const std::string space_, name_, uid_;
  StatusStore store_;
  PodDefaults defaults_;  // with the image that the world began with
  EventLog events_;
  std::string told_phase_;
  std::atomic<bool> stopping_ = false, done_ = false;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  Object object_;
  std::jthread thread_;
};

}  // namespace aureole::kubernetes
