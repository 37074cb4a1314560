// One kept-alive connection to the API server, by libcurl: HTTP/1.1, TLS 1.2 and newer against our CA only, no proxy,
// no redirects.
#pragma once

#include <chrono>
#include <functional>
#include <memory>
#include <optional>
#include <stop_token>
#include <string>
#include <vector>

#include <absl/status/status.h>

#include "server/control/kubernetes/cluster_access.h"

namespace aureole::kubernetes {

struct HttpRequest {
  std::string method, url;
  std::vector<std::string> headers = {};        // "Name: value"
  std::string body = "";                        // sent when not empty
  std::chrono::milliseconds timeout{0};         // of the whole exchange
  std::chrono::milliseconds header_timeout{0};  // until the reply begins; 0: as `timeout`
};

struct HttpReply {
  long status = 0;    // 0: none came
  bool sent = false;  // the server may have acted on the request
  std::string body;   // without what went to the sink
  std::optional<std::chrono::seconds> retry_after;
};

class HttpConnection {
 public:
  static constexpr std::chrono::seconds kConnectTimeout{5};
  // A dead peer, which sends no FIN, is noticed after about this long even when nothing is sent.
  static constexpr std::chrono::seconds kKeepaliveIdle{10}, kKeepaliveInterval{5}, kPeerTimeout{20};
  static constexpr size_t kMostBody = size_t{64} << 20;  // bytes; more is an error

  // `access` must outlive it.
  explicit HttpConnection(const ClusterAccess& access);
  ~HttpConnection();
  HttpConnection(const HttpConnection&) = delete;
  HttpConnection& operator=(const HttpConnection&) = delete;

  // The body of a 2xx reply goes there in parts, as they come, after one of no bytes when such a reply begins; false
  // ends the exchange, which then fails as Cancelled.
  using Sink = std::function<bool(const char* part, size_t bytes)>;

  // Blocks until the reply is complete. OK: there is a reply, whatever its status. Unavailable: no connection, a
  // handshake that failed, a time-out, or the reply ended too early. FailedPrecondition: the server or we could not
  // prove who it is. Cancelled: `stop`, then within milliseconds. ResourceExhausted: the body is larger than kMostBody.
  // One thread at a time.
  absl::Status Perform(const HttpRequest& request, const std::stop_token& stop, HttpReply* reply,
                       const Sink& sink = nullptr);

 private:
  struct Handles;
  std::unique_ptr<Handles> handles_;
  const ClusterAccess& access_;
};

}  // namespace aureole::kubernetes
