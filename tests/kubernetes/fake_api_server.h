// An API server for tests: objects of any kind in memory, with what a client has to get right: opaque versions,
// optimistic concurrency, lists in pages, watches with a history that can be forgotten, bookmarks, pods that are told
// to leave before they go; and faults on demand.
#pragma once

#include <httplib.h>

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "server/control/kubernetes/cluster_access.h"
#include "server/control/kubernetes/json.h"
#include "tests/kubernetes/tls_keys.h"

namespace aureole::kubernetes {

// What goes wrong with the next `times` requests of this method and with these texts in the target and the body.
struct Fault {
  enum class Kind : uint8_t {
    kStatus,       // refused with `status`
    kSlow,         // answered after `delay`
    kHang,         // not answered until Release
    kLostReply,    // done, but the reply ends within its body
    kBrokenJson,   // done, and the reply is complete, but its last byte is missing
    kGoneEvent,    // a watch: begins, then says 410 in an ERROR event
    kHalfLine,     // a watch: its first event is cut in the middle, with the connection
    kGarbageLine,  // a watch: a line that is not JSON
    kErrorEvent,   // a watch: an ERROR event with `status`
    kMute,         // a watch: begins, then says nothing any more and does not end
  };
  Kind kind = Kind::kStatus;
  std::string method = "GET", target = "";
  int times = 1;
  int status = 0;
  std::string reason = "";
  int retry_after = -1;  // seconds; -1: not said
  std::chrono::milliseconds delay{0};
  std::string body = "", message = "injected";
};

class FakeApiServer {
 public:
  // On a free port of 127.0.0.1; with TLS when there are keys, and then only for clients with a certificate of the
  // authority.
  explicit FakeApiServer(const TlsKeys* keys = nullptr);
  ~FakeApiServer();

  ClusterAccess Access() const;
  std::string url() const;

  // Nothing listens between the two; what is stored stays.
  void Stop();
  void Start();

  // Until the next call only requests with this token are accepted; empty: all.
  void AcceptOnly(const std::string& token);
  void Inject(Fault fault);
  void Release();              // of all that hang
  size_t faults_left() const;  // injected and not met yet
  void CutWatches();           // as a load balancer would, between two events
  void ForgetHistory();        // no list or watch can go on from versions before now; open watches go on
  void SendBookmarks();        // to all watches

  // As another client would. `path` is that of the object: "/api/v1/namespaces/a/pods/p".
  Json Put(const std::string& path, Json object);          // creates, or replaces whatever the version
  Json Merge(const std::string& path, const Json& patch);  // into what is there, the status too; null when nothing is
  void Remove(const std::string& path);                    // at once
  void PutLog(const std::string& pod, const std::string& text);
  std::optional<Json> At(const std::string& path) const;
  std::vector<Json> All(const std::string& collection) const;  // "/api/v1/namespaces/a/pods"

  // Requests that have come, as "GET /api/v1/pods?watch=1".
  int Count(const std::string& text) const;
  int watches() const;  // open now

 private:
  struct Place {
    std::string collection, space, name, subresource;  // collection: without the namespace
  };
  struct Entry {
    int64_t version = 0;
    Place place;
    std::string type;
    Json object;
  };

  static std::optional<Place> Parse(const std::string& path);
  static std::string KeyOf(const Place& place);
  static std::string Written(int64_t version);
  static std::optional<int64_t> VersionOf(const std::string& text);

  void Handle(const httplib::Request& request, httplib::Response& response);
  void Answer(const httplib::Request& request, const Place& place, httplib::Response& response);
  void List(const httplib::Request& request, const Place& place, httplib::Response& response);
  void Watch(const httplib::Request& request, const Place& place, std::optional<Fault> fault,
             httplib::Response& response);
  std::optional<Fault> TakeFault(const httplib::Request& request);
  static void Refuse(httplib::Response& response, int code, const std::string& reason, const std::string& message);
  Json Store(const Place& place, Json object, const char* type);
  bool Matches(const Place& wanted, const Place& place) const;

  const TlsKeys* const keys_;
  int port_ = 0;
  std::unique_ptr<httplib::Server> server_;
  std::thread thread_;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::map<std::string, std::pair<Place, Json>> objects_;
  std::deque<Entry> history_;
  int64_t version_ = 1, forgotten_ = 0;
  int64_t next_uid_ = 1;
  std::map<std::string, std::string> logs_;         // by the pod's key
  std::map<std::string, std::vector<Json>> pages_;  // rest of a list, by its continue token
  std::string token_;
  std::deque<Fault> faults_;
  std::vector<std::string> requests_;
  bool stopping_ = false;
  int releases_ = 0, cuts_ = 0, bookmarks_ = 0, watches_ = 0;
};

}  // namespace aureole::kubernetes
