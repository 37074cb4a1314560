// Region servers as Pods: one Pod for each incarnation of a region, owned by the World.
//
// A thread does all requests that may have to be repeated, so that no call here waits for the API server, but Adopt and
// Kill. A Pod is made once: its name says region and incarnation, and its arguments have the token by which a
// repetition knows its own.
//
// A node that dies is one like any other to the scheduler until the cluster knows, some 40 s later. So where a server
// was lost without its Pod's end, or a Pod was not even taken note of, Pods do not go for a while; but what finds no
// other place may run there too.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <map>
#include <mutex>
#include <stop_token>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/control/allocator.h"
#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/backoff.h"
#include "server/control/kubernetes/pod.h"
#include "server/control/kubernetes/reflector.h"
#include "server/control/kubernetes/wakeup.h"

namespace aureole::kubernetes {

class PodAllocator final : public Allocator {
 public:
  struct Options {
    PodTemplate pods;
    // Asked before every write: a control plane that leads no more changes nothing. Any thread.
    std::function<bool()> leads = [] { return true; };
    // A server that does not run so long after its Pod was made is told of as ended, with what Kubernetes says.
    std::chrono::milliseconds start_patience{90000};
    std::chrono::milliseconds leave_margin{5000};    // beyond the time that a deleted Pod has; then its node is lost
    std::chrono::milliseconds take_patience{10000};  // for a node to say something about its Pod; then it is lost
    std::chrono::milliseconds avoid_for{120000};     // a node that may be lost
    std::chrono::milliseconds avoid_patience{3000};  // for a place elsewhere; then the next Pod avoids no node
    std::chrono::milliseconds kill_patience{10000};  // for Pods to go; nodes that are lost do not answer
    std::chrono::milliseconds first_pause{100}, longest_pause{10000};  // after failures of the API server
  };

  // `client` must outlive it.
  PodAllocator(ApiClient* client, Options options);
  ~PodAllocator() override;
  PodAllocator(const PodAllocator&) = delete;
  PodAllocator& operator=(const PodAllocator&) = delete;

  // The newest server of each region that has not ended. Unavailable: the API server has not answered in time.
  absl::StatusOr<std::vector<ServerStart>> Adopt() override;
  void Release() override;
  bool released() const { return released_; }

  // Never fails: a Pod that is refused is a server that has ended, "its Pod cannot be made: ...".
  absl::Status Start(const ServerStart& start) override;
  std::vector<ServerExit> Poll() override;
  int running() const override;
  // The server is told of as ended at once: its node may be lost, and the next one fences it.
  void End(RegionId region, uint64_t incarnation) override;
  // Also those that earlier control planes have started.
  void Kill() override;

  // Any thread. For Pods made from now on.
  void Use(PodTemplate pods);
  // Any thread. The newest Pod of each region, as last seen.
  std::map<RegionId, PodView> Newest() const;

 private:
  using Clock = std::chrono::steady_clock;
  using Key = std::pair<RegionId, uint64_t>;  // region, incarnation
  struct Server {
    enum class Stage : uint8_t {
      kWanted,  // its Pod is to be made
      kMade,    // its Pod is there, as far as is known
      kEnded,   // told of; its Pod may be there still. Also Pods of earlier control planes
      kGone     // its Pod is deleted
    };
    Server(ServerStart s, Stage at, const std::string& of, Backoff pauses)
        : start(std::move(s)), stage(at), uid(of), backoff(std::move(pauses)) {}
    ServerStart start;
    Stage stage;
    bool remove = false;  // its Pod
    bool seen = false;    // its Pod, by the watch
    bool started = false;
    bool untaken = false;  // its Pod was given up before its node took note of it
    std::string uid;       // of its Pod; empty: not known
    std::string node;      // likewise
    std::string trouble;   // why its Pod could not be made yet
    Clock::time_point made, next_try, next_check;
    Clock::time_point leaving_since, untaken_since, unschedulable_since;  // none: it is not
    Backoff backoff;
  };

  void Run(const std::stop_token& stop);
  void Look(const std::stop_token& stop);
  void LookAt(const Json& pod, bool gone, const std::stop_token& stop);
  // Requests that are due, one after the other.
  void Work(const std::stop_token& stop);
  void Make(const Key& key, const std::stop_token& stop);
  absl::Status MakeClaim(const PodTemplate& pods, RegionId region, const std::stop_token& stop);
  // Its uid.
  absl::StatusOr<std::string> MakePod(const PodTemplate& pods, const ServerStart& start,
                                      const std::vector<std::string>& avoid, const std::stop_token& stop);
  void Remove(const Key& key, const std::stop_token& stop);
  void Check(const Key& key, const std::stop_token& stop);
  absl::Status Delete(const std::string& name, const std::string& uid, int grace_seconds, const std::stop_token& stop);
  // The Pods of this World.
  absl::StatusOr<std::vector<Json>> List();
  std::string NameOf(const Key& key) const { return PodName(world_, key.first, key.second); }
  // These hold the mutex.
  Server& Add(const ServerStart& start, Server::Stage stage, const std::string& uid);
  void Tell(Server* server, bool clean, const std::string& how, const std::string& log_tail = "");
  uint64_t NewestOf(RegionId region) const;
  // Ends a server whose Pod does not get on in time.
  void Judge(Server* server, const PodView& view, Clock::time_point now);
  void Avoid(const std::string& node, Clock::time_point now);
  std::vector<std::string> Avoided(RegionId region, Clock::time_point now) const;
  bool GoesAnywhere(RegionId region, Clock::time_point now) const;

  ApiClient* const client_;
  const Options options_;
  const std::string world_, uid_;
  const Resource pods_;
  Wakeup wakeup_;
  bool released_ = false;

  mutable std::mutex mutex_;  // guards what follows, up to the reflector
  PodTemplate template_;
  std::map<Key, Server> servers_;
  std::vector<ServerExit> exits_;                     // to be polled
  bool working_ = false;                              // a request is on its way
  std::map<std::string, Clock::time_point> avoided_;  // nodes that may be lost, until then
  std::map<RegionId, Clock::time_point> anywhere_;    // regions that have no other place, until then

  Reflector reflector_;
  std::jthread thread_;
};

}  // namespace aureole::kubernetes
