#include "tests/kubernetes/fake_cluster.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <poll.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <fstream>
#include <set>
#include <sstream>

#include <absl/strings/numbers.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_replace.h>
#include <absl/strings/strip.h>

#include "server/control/kubernetes/pod.h"
#include "server/core/check.h"

namespace aureole::kubernetes {
namespace {

using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;

constexpr char kPods[] = "/api/v1/namespaces/test/pods";
constexpr char kClaims[] = "/api/v1/namespaces/test/persistentvolumeclaims";
constexpr char kWorlds[] = "/apis/aureole.dev/v1alpha1/namespaces/test/worlds";
constexpr int kControlPort = 7100;

sockaddr_in At(const std::string& ip, int port) {
  sockaddr_in out{};
  out.sin_family = AF_INET;
  out.sin_port = htons(static_cast<uint16_t>(port));
  inet_pton(AF_INET, ip.c_str(), &out.sin_addr);
  return out;
}

Json ContainerState(const Json& state) {
  return {{"containerStatuses", Json::array({{{"name", "region"}, {"state", state}}})}};
}

bool Selects(const Json& selector, const Json& pod) {
  const Json labels = pod["metadata"].value("labels", Json::object());
  const Json exact = selector.value("matchLabels", Json::object());
  const Json in = selector.value("matchExpressions", Json::array());
  for (const auto& [key, value] : exact.items()) {
    if (labels.value(key, "") != value) return false;
  }
  return std::all_of(in.begin(), in.end(), [&](const Json& term) {
    const Json& values = term["values"];
    return std::find(values.begin(), values.end(), labels.value(TextAt(term, {"key"}), "")) != values.end();
  });
}

// How much the Pod prefers to be where the other one is.
int Likes(const Json& pod, const Json& other) {
  int sum = 0;
  for (const auto& [kind, sign] : {std::pair("podAffinity", 1), std::pair("podAntiAffinity", -1)}) {
    const Json* const terms = Find(pod, {"spec", "affinity", kind, "preferredDuringSchedulingIgnoredDuringExecution"});
    if (terms == nullptr) continue;
    for (const Json& term : *terms) {
      if (Selects(term["podAffinityTerm"]["labelSelector"], other)) sum += sign * term["weight"].get<int>();
    }
  }
  return sum;
}

// Whether it must not be on the node.
bool Avoids(const Json& pod, const std::string& node) {
  const Json* const terms = Find(
      pod, {"spec", "affinity", "nodeAffinity", "requiredDuringSchedulingIgnoredDuringExecution", "nodeSelectorTerms"});
  if (terms == nullptr) return false;
  const Json& fields = terms->front()["matchFields"];
  return std::any_of(fields.begin(), fields.end(), [&](const Json& field) {
    AUREOLE_CHECK(field["key"] == "metadata.name" && field["operator"] == "NotIn" && field["values"].size() == 1,
                  "the real one refuses %s", field.dump().c_str());
    return field["values"][0] == node;
  });
}

// Signals that are blocked, and handlers, are inherited: children begin with none.
[[noreturn]] void RunChild(char* const* words, char* const* environment, int log, pid_t parent) {
  prctl(PR_SET_PDEATHSIG, SIGKILL);
  if (getppid() != parent) _exit(127);
  sigset_t none;
  sigemptyset(&none);
  sigprocmask(SIG_SETMASK, &none, nullptr);
  signal(SIGPIPE, SIG_DFL);
  dup2(log, STDOUT_FILENO);
  dup2(log, STDERR_FILENO);
  execve(words[0], words, environment);
  _exit(127);
}

}  // namespace

FakeCluster::FakeCluster(int nodes) {
  std::string name = (std::filesystem::temp_directory_path() / "cluster.XXXXXX").string();
  directory_ = mkdtemp(name.data());
  std::filesystem::create_directories(disk());
  for (int i = 1; i <= nodes; ++i) nodes_[absl::StrCat("n", i)] = Node::kThere;
  // Tests run at the same time; the test process' number keeps them apart.
  subnet_ = absl::StrCat("127.", 64 + getpid() % 128, ".", getpid() / 128 % 256, ".");
  service_ = Address();
  api_.Put("/api/v1/namespaces/test/services/aureole-control",
           {{"spec", {{"clusterIP", service_}, {"ports", Json::array({{{"port", kControlPort}}})}}}});
  std::ofstream(directory_ / "kubeconfig")
      << Json{{"apiVersion", "v1"},
              {"kind", "Config"},
              {"current-context", "c"},
              {"clusters", Json::array({{{"name", "k"}, {"cluster", {{"server", api_.url()}}}}})},
              {"users", Json::array({{{"name", "u"}, {"user", Json::object()}}})},
              {"contexts",
               Json::array({{{"name", "c"}, {"context", {{"cluster", "k"}, {"user", "u"}, {"namespace", "test"}}}}})}};
  listener_ = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
  const int on = 1;
  setsockopt(listener_, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on);
  const sockaddr_in at = At(service_, kControlPort);
  AUREOLE_CHECK(bind(listener_, reinterpret_cast<const sockaddr*>(&at), sizeof at) == 0 && listen(listener_, 64) == 0,
                "cannot listen on %s", service_.c_str());
  kubelet_ = std::jthread([this](const std::stop_token& stop) { Run(stop); });
  proxy_ = std::jthread([this](const std::stop_token& stop) { ServeLeader(stop); });
}

FakeCluster::~FakeCluster() {
  for (auto& [index, control] : controls_) {
    if (control.pid <= 0) continue;
    kill(control.pid, SIGKILL);
    waitpid(control.pid, nullptr, 0);
  }
  kubelet_.request_stop();
  kubelet_.join();
  for (auto& [uid, container] : containers_) {
    if (container.pid <= 0) continue;
    kill(container.pid, SIGKILL);
    waitpid(container.pid, nullptr, 0);
  }
  proxy_.request_stop();
  proxy_.join();
  {
    const std::lock_guard lock(mutex_);
    for (const int s : sockets_) shutdown(s, SHUT_RDWR);
  }
  for (std::thread& t : forwarders_) t.join();
  close(listener_);
  std::error_code ignored;
  std::filesystem::remove_all(directory_, ignored);
}

std::string FakeCluster::Address() { return absl::StrCat(subnet_, next_address_++); }

pid_t FakeCluster::Spawn(const std::vector<std::string>& words, const std::vector<std::string>& environment,
                         const std::string& log) {
  std::vector<char*> arguments, variables;
  for (const std::string& w : words) arguments.push_back(const_cast<char*>(w.c_str()));
  for (const std::string& e : environment) variables.push_back(const_cast<char*>(e.c_str()));
  arguments.push_back(nullptr);
  variables.push_back(nullptr);
  const int out = open(log.c_str(), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
  AUREOLE_CHECK(out >= 0, "cannot write %s", log.c_str());
  const pid_t parent = getpid();
  const pid_t pid = fork();
  if (pid == 0) RunChild(arguments.data(), variables.data(), out, parent);
  close(out);
  return pid;
}

void FakeCluster::StartControl(int index, const std::vector<std::string>& flags, const std::string& image) {
  const std::string name = absl::StrCat("control-", index), ip = Address();
  const std::string path = absl::StrCat(kPods, "/", name);
  api_.Remove(path);
  api_.Put(path, {{"metadata", {{"labels", {{"app.kubernetes.io/name", "aureole-control"}}}}},
                  {"spec", {{"containers", Json::array({{{"name", "control"}, {"image", image}}})}}},
                  {"status", {{"podIP", ip}}}});
  const std::lock_guard lock(mutex_);
  std::vector<std::string> words = {AUREOLE_CONTROL,   "kubernetes", "--listen",  absl::StrCat(ip, ":", kControlPort),
                                    "--lease-seconds", "3",          "--metrics", absl::StrCat(ip, ":9100")};
  words.insert(words.end(), flags.begin(), flags.end());
  controls_[index].pid = Spawn(words,
                               {absl::StrCat("KUBECONFIG=", (directory_ / "kubeconfig").string()),
                                absl::StrCat("POD_NAME=", name), "POD_NAMESPACE=test", absl::StrCat("POD_IP=", ip)},
                               directory_ / absl::StrCat(name, ".log"));
}

void FakeCluster::SignalControl(int index, int signal) {
  const std::lock_guard lock(mutex_);
  kill(controls_[index].pid, signal);
}

bool FakeCluster::ControlRuns(int index) {
  const std::lock_guard lock(mutex_);
  Control& control = controls_[index];
  if (control.pid > 0 && waitpid(control.pid, nullptr, WNOHANG) == control.pid) control.pid = -1;
  return control.pid > 0;
}

int FakeCluster::Leader() {
  for (const Json& pod : api_.All(kPods)) {
    int index = -1;
    const std::string whole = TextAt(pod, {"metadata", "name"});
    absl::string_view name = whole;
    if (TextAt(pod, {"metadata", "labels", "aureole.dev/role"}) == "leader" && absl::ConsumePrefix(&name, "control-") &&
        absl::SimpleAtoi(name, &index)) {
      return index;
    }
  }
  return -1;
}

Json FakeCluster::World(const std::string& name) {
  const auto world = api_.At(absl::StrCat("/apis/aureole.dev/v1alpha1/namespaces/test/worlds/", name));
  return world ? *world : Json();
}

std::vector<Json> FakeCluster::Pods(const std::string& world) {
  std::vector<Json> out = api_.All(kPods);
  std::erase_if(out, [&](const Json& pod) { return TextAt(pod, {"metadata", "labels", kWorldLabel}) != world; });
  return out;
}

pid_t FakeCluster::ProcessOf(const std::string& pod) {
  const std::lock_guard lock(mutex_);
  const auto uid = uid_of_.find(pod);
  return uid == uid_of_.end() ? -1 : containers_[uid->second].pid;
}

size_t FakeCluster::processes() {
  const std::lock_guard lock(mutex_);
  return static_cast<size_t>(
      std::count_if(containers_.begin(), containers_.end(), [](const auto& entry) { return entry.second.pid > 0; }));
}

void FakeCluster::LoseNode(const std::string& node, bool processes_go_on, bool cluster_knows) {
  const std::lock_guard lock(mutex_);
  nodes_[node] = cluster_knows ? Node::kLost : Node::kSilent;
  for (auto& [uid, container] : containers_) {
    if (container.node == node && container.pid > 0 && !processes_go_on) kill(container.pid, SIGKILL);
  }
}

std::string FakeCluster::Logs() const {
  std::ostringstream out;
  for (const auto& entry : std::filesystem::directory_iterator(directory_)) {
    if (entry.path().extension() != ".log") continue;
    out << "---- " << entry.path().filename().string() << "\n" << std::ifstream(entry.path()).rdbuf() << "\n";
  }
  return out.str();
}

// What belongs to a World that is not there any more is deleted: Pods have their time to end.
void FakeCluster::CollectGarbage() {
  std::set<std::string> worlds;
  const std::vector<Json> pods = api_.All(kPods), claims = api_.All(kClaims);
  for (const Json& world : api_.All(kWorlds)) worlds.insert(TextAt(world, {"metadata", "uid"}));
  const auto orphaned = [&worlds](const Json& object) {
    const Json* const owners = Find(object, {"metadata", "ownerReferences"});
    return owners != nullptr && !worlds.contains(TextAt(owners->front(), {"uid"}));
  };
  for (const Json& claim : claims) {
    if (orphaned(claim)) api_.Remove(absl::StrCat(kClaims, "/", TextAt(claim, {"metadata", "name"})));
  }
  for (const Json& pod : pods) {
    if (!orphaned(pod) || pod["metadata"].contains("deletionTimestamp")) continue;
    api_.Merge(absl::StrCat(kPods, "/", TextAt(pod, {"metadata", "name"})),
               {{"metadata", {{"deletionTimestamp", "2026-01-01T00:00:00Z"}, {"deletionGracePeriodSeconds", 30}}}});
  }
}

// Scheduler, garbage collector and all kubelets.
void FakeCluster::Run(const std::stop_token& stop) {
  int round = 0;
  while (!stop.stop_requested()) {
    CollectGarbage();
    for (const Json& pod : api_.All(kPods)) {
      if (TextAt(pod, {"metadata", "labels", kWorldLabel}).empty()) continue;
      const std::string path = absl::StrCat(kPods, "/", TextAt(pod, {"metadata", "name"}));
      if (TextAt(pod, {"spec", "nodeName"}).empty()) {
        Schedule(path, pod, round++);
      } else {
        Tend(path, pod);
      }
    }
    std::this_thread::sleep_for(milliseconds(20));
  }
}

// Every node is a zone of its own.
void FakeCluster::Schedule(const std::string& path, const Json& pod, int round) {
  std::map<std::string, int> scores;
  {
    const std::lock_guard lock(mutex_);
    for (const auto& [node, state] : nodes_) {
      if (state != Node::kLost && !Avoids(pod, node)) scores[node] = 0;
    }
  }
  for (const Json& other : api_.All(kPods)) {
    const auto score = scores.find(TextAt(other, {"spec", "nodeName"}));
    if (score == scores.end() || other["metadata"].contains("deletionTimestamp")) continue;
    score->second += Likes(pod, other) + Likes(other, pod);
  }
  std::vector<std::string> best;
  for (const auto& [node, score] : scores) {
    if (!best.empty() && score > scores[best.front()]) best.clear();
    if (best.empty() || score == scores[best.front()]) best.push_back(node);
  }
  if (best.empty()) {
    if (ReadPod(pod)->unschedulable) return;
    const Json condition = {{"type", "PodScheduled"}, {"status", "False"}, {"message", "no node is available"}};
    api_.Merge(path, {{"status", {{"phase", "Pending"}, {"conditions", Json::array({condition})}}}});
    return;
  }
  api_.Merge(path, {{"spec", {{"nodeName", best[static_cast<size_t>(round) % best.size()]}}}});
}

void FakeCluster::Tend(const std::string& path, const Json& pod) {
  const std::string uid = TextAt(pod, {"metadata", "uid"}), node = TextAt(pod, {"spec", "nodeName"});
  std::unique_lock lock(mutex_);
  if (nodes_[node] != Node::kThere) return;
  const bool leaving = pod["metadata"].contains("deletionTimestamp");
  if (!containers_.contains(uid)) {
    lock.unlock();
    if (leaving) return api_.Remove(path);
    return StartContainer(path, pod, node);
  }
  Container& container = containers_[uid];
  int status = 0;
  if (container.pid > 0 && waitpid(container.pid, &status, WNOHANG) == container.pid) {
    container.pid = -1;
    const int code = WIFSIGNALED(status) ? 128 + WTERMSIG(status) : WEXITSTATUS(status);
    std::ifstream log(container.log);
    api_.PutLog(path, std::string(std::istreambuf_iterator<char>(log), {}));
    Json ended = ContainerState({{"terminated", {{"exitCode", code}, {"reason", code == 0 ? "Completed" : "Error"}}}});
    ended["phase"] = code == 0 ? "Succeeded" : "Failed";
    api_.Merge(path, {{"status", ended}});
  }
  if (!leaving) return;
  if (container.pid <= 0) return api_.Remove(path);
  if (!container.told_to_end) {
    container.told_to_end = true;
    container.kill_at =
        Clock::now() + std::chrono::seconds(IntegerAt(pod, {"metadata", "deletionGracePeriodSeconds"}).value_or(30));
    kill(container.pid, SIGTERM);
  }
  if (Clock::now() >= container.kill_at) kill(container.pid, SIGKILL);
}

void FakeCluster::StartContainer(const std::string& path, const Json& pod, const std::string& node) {
  const std::string name = TextAt(pod, {"metadata", "name"}), uid = TextAt(pod, {"metadata", "uid"}), ip = Address();
  const Json& volume = pod["spec"]["volumes"][0];
  std::string data = TextAt(volume, {"hostPath", "path"});
  if (data.empty()) {
    const std::string claim = TextAt(volume, {"persistentVolumeClaim", "claimName"});
    data = directory_ / (claim.empty() ? "empty-" + uid : "claim-" + claim);
  }
  std::vector<std::string> words = {AUREOLE_REGION};
  std::string flag;
  for (const Json& arg : pod["spec"]["containers"][0]["args"]) {
    std::string word = absl::StrReplaceAll(arg.get<std::string>(), {{"$(POD_IP)", ip}});
    if (flag == "--data") word = data + word.substr(std::string("/data").size());
    words.push_back(word);
    flag = word;
  }
  Container container;
  container.node = node;
  container.log = directory_ / absl::StrCat(name, ".log");
  container.pid = Spawn(words, {absl::StrCat("POD_IP=", ip)}, container.log);
  {
    const std::lock_guard lock(mutex_);
    containers_[uid] = container;
    uid_of_[name] = uid;
  }
  Json running = ContainerState({{"running", Json::object()}});
  running["phase"] = "Running";
  running["podIP"] = ip;
  api_.Merge(path, {{"status", running}});
}

// As kube-proxy would, for the one Service.
void FakeCluster::ServeLeader(const std::stop_token& stop) {
  while (!stop.stop_requested()) {
    pollfd ready{listener_, POLLIN, 0};
    if (poll(&ready, 1, 50) <= 0) continue;
    const int client = accept4(listener_, nullptr, nullptr, SOCK_CLOEXEC);
    if (client >= 0) Forward(client);
  }
}

void FakeCluster::Forward(int client) {
  const int leader = Leader();
  const auto pod = api_.At(absl::StrCat(kPods, "/control-", leader));
  const int server = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
  const sockaddr_in to = At(pod ? TextAt(*pod, {"status", "podIP"}) : "", kControlPort);
  if (!pod || connect(server, reinterpret_cast<const sockaddr*>(&to), sizeof to) != 0) {
    close(client);
    close(server);
    return;
  }
  const auto pump = [](int from, int into) {
    char bytes[16384];
    for (ssize_t n; (n = read(from, bytes, sizeof bytes)) > 0;) {
      for (ssize_t sent = 0; sent < n;) {
        const ssize_t s = send(into, bytes + sent, static_cast<size_t>(n - sent), MSG_NOSIGNAL);
        if (s <= 0) break;
        sent += s;
      }
    }
    shutdown(into, SHUT_RDWR);
    shutdown(from, SHUT_RDWR);
  };
  const std::lock_guard lock(mutex_);
  sockets_.push_back(client);
  sockets_.push_back(server);
  forwarders_.emplace_back(pump, client, server);
  forwarders_.emplace_back(pump, server, client);
}

}  // namespace aureole::kubernetes
