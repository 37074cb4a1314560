// A cluster for tests: the fake API server, nodes that run what a Pod says as processes of this machine, a scheduler
// that weighs what Pods prefer, the garbage collector, control planes, and the Service by which their leader is found.
// Every Pod has an address of its own in 127.0.0.0/8.
#pragma once

#include <sys/types.h>

#include <atomic>
#include <chrono>
#include <filesystem>
#include <map>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "server/core/types.h"  // Eigen, before <resolv.h>, which httplib.h includes, defines _res
#include "tests/kubernetes/fake_api_server.h"

namespace aureole::kubernetes {

class FakeCluster {
 public:
  explicit FakeCluster(int nodes = 2);
  // Kills all that runs.
  ~FakeCluster();

  FakeApiServer& api() { return api_; }
  // Checkpoints, for World's storage.hostPath: the same on all nodes.
  std::string disk() const { return directory_ / "disk"; }

  // A control plane, `index` 0, 1, ...; again after it has ended. `flags`: further ones of its command line; `image`:
  // what its Pod says.
  void StartControl(int index, const std::vector<std::string>& flags = {}, const std::string& image = "aureole");
  void SignalControl(int index, int signal);
  bool ControlRuns(int index);
  int Leader();  // whose Pod has the label; -1: none
  // Which leads to it, host:port.
  const std::string& service() const { return service_; }

  Json World(const std::string& name);  // null when there is none
  std::vector<Json> Pods(const std::string& world);
  // The processes of a Pod, -1: none.
  pid_t ProcessOf(const std::string& pod);
  size_t processes();  // of Pods, that run

  // The node says and does nothing any more; its processes go on, or not. While the cluster does not know, the
  // scheduler takes the node for one like any other.
  void LoseNode(const std::string& node, bool processes_go_on, bool cluster_knows = true);
  // What everything wrote, for a test that fails.
  std::string Logs() const;

 private:
  enum class Node : uint8_t { kThere, kSilent, kLost };  // silent: the cluster does not know yet
  struct Container {
    std::string node, log;
    pid_t pid = -1;
    bool told_to_end = false, ended = false;
    std::chrono::steady_clock::time_point kill_at;
  };
  struct Control {
    pid_t pid = -1;
  };

  std::string Address();
  void Run(const std::stop_token& stop);
  void CollectGarbage();
  void Schedule(const std::string& path, const Json& pod, int round);
  void Tend(const std::string& path, const Json& pod);
  void StartContainer(const std::string& path, const Json& pod, const std::string& node);
  void ServeLeader(const std::stop_token& stop);
  void Forward(int client);
  pid_t Spawn(const std::vector<std::string>& words, const std::vector<std::string>& environment,
              const std::string& log);

  FakeApiServer api_;
  std::filesystem::path directory_;
  std::string subnet_;  // "127.70.3."
  std::string service_;
  std::atomic<int> next_address_ = 1;
  int listener_ = -1;

  std::mutex mutex_;
  std::map<std::string, Node> nodes_;
  std::map<std::string, Container> containers_;  // by the Pod's uid
  std::map<std::string, std::string> uid_of_;    // by the Pod's name
  std::map<int, Control> controls_;
  std::vector<int> sockets_;
  std::vector<std::thread> forwarders_;
  std::jthread kubelet_, proxy_;
};

}  // namespace aureole::kubernetes
