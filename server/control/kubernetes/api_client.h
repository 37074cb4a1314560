// Requests to the API server: JSON in, JSON out. Each call blocks; any number of threads may call.
#pragma once

#include <atomic>
#include <chrono>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <stop_token>
#include <string>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/control/kubernetes/bearer_token.h"
#include "server/control/kubernetes/cluster_access.h"
#include "server/control/kubernetes/http_connection.h"
#include "server/control/kubernetes/json.h"
#include "server/control/kubernetes/resource.h"

namespace aureole::kubernetes {

// A request that can be repeated without harm is: after a time-out, a broken connection, 429 and 5xx; with pauses that
// double from 100 ms, with jitter, or as the server's Retry-After says. Any request is repeated that surely was not
// acted on: no connection, or 429. After a 401 the token's file is read, and the request repeated once with another
// token.
struct CallOptions {
  std::chrono::milliseconds timeout{30000};          // of the call, repetitions and pauses included
  std::chrono::milliseconds attempt_timeout{10000};  // of one request
  int attempts = 4;
  std::stop_token stop = {};  // then the call ends within milliseconds, as Cancelled
};

struct Selection {
  std::string labels = "";  // "app=aureole,region"
  std::string fields = "";  // "metadata.name=a"
};

struct ObjectList {
  std::vector<Json> items;       // of built-in kinds: without apiVersion and kind
  std::string resource_version;  // of the list: a watch goes on from here
};

struct Patch {
  enum class Kind : uint8_t {
    kMerge,  // lists are replaced whole; null removes
    kJson,   // a list of operations; `test` makes it a compare-and-set
    kApply,  // server-side apply of all that `field_manager` wants; creates what is not there
  };
  Kind kind = Kind::kMerge;
  Json body;
  std::string field_manager = "";  // required for kApply
  bool force = false;              // kApply: takes fields over from other managers
};

struct DeleteOptions {
  std::string propagation = "Background";  // or "Foreground", "Orphan"
  std::string uid = "";                    // preconditions when not empty: a conflict (Aborted) if it is another
  std::string resource_version = "";
  std::optional<int> grace_period_seconds = std::nullopt;
};

struct WatchEvent {
  enum class Kind : uint8_t { kAdded, kModified, kDeleted, kBookmark };
  Kind kind = Kind::kAdded;
  Json object;  // of a bookmark: nothing but metadata.resourceVersion
};

struct WatchOptions {
  std::chrono::seconds timeout{300};  // the server ends the watch after that
  // For the reply to begin, and for the end after `timeout`: a server that is silent beyond that is given up.
  std::chrono::milliseconds grace{10000};
  std::stop_token stop = {};
  std::function<void()> opened = [] {};  // called when the server has agreed
};

struct ApiStats {
  int64_t requests = 0;        // sent or tried
  int64_t repeated = 0;        // of these, because the one before had failed
  int64_t tokens_renewed = 0;  // after a 401
  int64_t refused = 0;         // as not valid: 400, 413, 415, 422
};

class ApiClient {
 public:
  static constexpr int kPage = 500;                      // objects per request of a list
  static constexpr size_t kMostLine = size_t{16} << 20;  // bytes of a watch event; more is an error

  explicit ApiClient(ClusterAccess access);
  ~ApiClient();
  ApiClient(const ApiClient&) = delete;
  ApiClient& operator=(const ApiClient&) = delete;

  // Our own namespace.
  const std::string& space() const { return access_.space; }
  ApiStats stats() const;

  // Codes: api_status.h. Besides: InvalidArgument when the request names no object (nothing is sent), and the errors of
  // HttpConnection::Perform.
  absl::StatusOr<Json> Get(const Resource& resource, const std::string& name, const CallOptions& options = {});
  // The last lines that a pod's only container has written; one try.
  absl::StatusOr<std::string> Log(const std::string& space, const std::string& pod, int lines,
                                  const CallOptions& options = {});
  // All pages. When the server forgets the snapshot in between (410), it begins again without pages.
  absl::StatusOr<ObjectList> List(const Resource& resource, const Selection& selection = {},
                                  const CallOptions& options = {});
  absl::StatusOr<Json> Create(const Resource& resource, const Json& object, const CallOptions& options = {});
  // Aborted when metadata.resourceVersion, which is required, is not the newest. A repetition after a lost reply is
  // Aborted, too: read again to see.
  absl::StatusOr<Json> Replace(const Resource& resource, const Json& object, const CallOptions& options = {});
  // Repeated as above, unless it is kJson, whose operations may not bear it.
  absl::StatusOr<Json> Patch(const Resource& resource, const std::string& name, const kubernetes::Patch& patch,
                             const CallOptions& options = {});
  // OK: it is gone, or will be when its finalizers and grace period are through. NotFound: it was gone. Repeated only
  // when preconditions name which object is meant, not only its name.
  absl::Status Delete(const Resource& resource, const std::string& name, const DeleteOptions& what = {},
                      const CallOptions& options = {});

  // Everything that happens after `resource_version`, in order, until the watch times out (OK), is stopped (Cancelled),
  // or `take` returns an error (that). OutOfRange: the server has forgotten that version, by either form of 410: list
  // again. Unavailable: broken; what `take` got is whole and in order, so go on from its last version. One try.
  absl::Status Watch(const Resource& resource, const Selection& selection, const std::string& resource_version,
                     const WatchOptions& options, const std::function<absl::Status(WatchEvent)>& take);

 private:
  struct Request {
    std::string method, path;  // with the query
    std::string body = "", content_type = "";
    bool repeatable = false;
  };
  absl::StatusOr<Json> Call(const Request& request, const CallOptions& options);
  absl::StatusOr<Json> CallOnce(const Request& request, std::chrono::milliseconds timeout, const std::stop_token& stop,
                                bool* acted_on);
  // With the token; once more with a new one after a 401.
  absl::Status Exchange(HttpRequest* request, const std::stop_token& stop, HttpReply* reply,
                        const HttpConnection::Sink& sink);
  std::unique_ptr<HttpConnection> TakeConnection();
  void GiveBack(std::unique_ptr<HttpConnection> connection);

  const ClusterAccess access_;
  BearerToken token_;
  std::mutex mutex_;
  std::vector<std::unique_ptr<HttpConnection>> idle_;
  std::atomic<int64_t> requests_{0}, repeated_{0}, tokens_renewed_{0}, refused_{0};
};

}  // namespace aureole::kubernetes
