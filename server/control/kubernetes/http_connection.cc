#include "server/control/kubernetes/http_connection.h"

#include <curl/curl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>

#include <algorithm>
#include <mutex>

#include <absl/strings/ascii.h>
#include <absl/strings/match.h>
#include <absl/strings/numbers.h>
#include <absl/strings/str_cat.h>

#include "server/core/check.h"

namespace aureole::kubernetes {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::chrono::seconds kMostRetryAfter{60};

// Where the parts of one exchange go.
struct Exchange {
  CURL* easy = nullptr;
  HttpReply* reply = nullptr;
  const HttpConnection::Sink* sink = nullptr;
  bool refused_by_sink = false, too_large = false, begun = false;
};

bool GoesToSink(const Exchange& exchange) {
  long status = 0;
  curl_easy_getinfo(exchange.easy, CURLINFO_RESPONSE_CODE, &status);
  return *exchange.sink && status / 100 == 2;
}

size_t TakeBody(char* part, size_t, size_t bytes, void* user) {
  auto* const exchange = static_cast<Exchange*>(user);
  if (GoesToSink(*exchange)) {
    exchange->refused_by_sink = !(*exchange->sink)(part, bytes);
    return exchange->refused_by_sink ? 0 : bytes;
  }
  exchange->too_large = exchange->reply->body.size() + bytes > HttpConnection::kMostBody;
  if (exchange->too_large) return 0;
  exchange->reply->body.append(part, bytes);
  return bytes;
}

size_t TakeHeader(char* part, size_t, size_t bytes, void* user) {
  auto* const exchange = static_cast<Exchange*>(user);
  exchange->begun = true;
  const std::string line(part, bytes);
  if (line == "\r\n" && GoesToSink(*exchange)) (*exchange->sink)(nullptr, 0);
  int seconds = 0;  // a date is not understood, and taken for no header
  if (absl::StartsWithIgnoreCase(line, "Retry-After:") && absl::SimpleAtoi(line.substr(12), &seconds) && seconds >= 0) {
    exchange->reply->retry_after = std::min(std::chrono::seconds(seconds), kMostRetryAfter);
  }
  return bytes;
}

int SetSocketOptions(void*, curl_socket_t socket, curlsocktype) {
  const auto set = [&](int option, std::chrono::milliseconds value, int unit_ms) {
    const int number = static_cast<int>(value.count() / unit_ms);
    setsockopt(socket, IPPROTO_TCP, option, &number, sizeof number);
  };
  const int on = 1;
  setsockopt(socket, SOL_SOCKET, SO_KEEPALIVE, &on, sizeof on);
  set(TCP_KEEPIDLE, HttpConnection::kKeepaliveIdle, 1000);
  set(TCP_KEEPINTVL, HttpConnection::kKeepaliveInterval, 1000);
  set(TCP_USER_TIMEOUT, HttpConnection::kPeerTimeout, 1);
  return CURL_SOCKOPT_OK;
}

void SetBlob(CURL* easy, CURLoption option, const std::string& pem) {
  if (pem.empty()) return;
  // The access outlives the handle.
  curl_blob blob{const_cast<char*>(pem.data()), pem.size(), CURL_BLOB_NOCOPY};
  curl_easy_setopt(easy, option, &blob);
}

bool IsIdentityError(CURLcode code) {
  return code == CURLE_PEER_FAILED_VERIFICATION || code == CURLE_SSL_CERTPROBLEM || code == CURLE_SSL_CACERT_BADFILE ||
         code == CURLE_SSL_ISSUER_ERROR;
}

bool IsBeforeSending(CURLcode code) {
  return code == CURLE_COULDNT_CONNECT || code == CURLE_COULDNT_RESOLVE_HOST || code == CURLE_SSL_CONNECT_ERROR ||
         IsIdentityError(code);
}

struct HeaderList {
  ~HeaderList() { curl_slist_free_all(list); }
  void Add(const std::string& line) { list = curl_slist_append(list, line.c_str()); }
  curl_slist* list = nullptr;
};

}  // namespace

struct HttpConnection::Handles {
  CURLM* multi = curl_multi_init();  // keeps the connection between exchanges
  CURL* easy = curl_easy_init();
};

HttpConnection::HttpConnection(const ClusterAccess& access) : access_(access) {
  static std::once_flag once;
  std::call_once(once, [] { curl_global_init(CURL_GLOBAL_DEFAULT); });
  handles_ = std::make_unique<Handles>();
  AUREOLE_CHECK(handles_->multi != nullptr && handles_->easy != nullptr, "libcurl has no handle");
  curl_multi_setopt(handles_->multi, CURLMOPT_MAXCONNECTS, 1L);
}

HttpConnection::~HttpConnection() {
  curl_easy_cleanup(handles_->easy);
  curl_multi_cleanup(handles_->multi);
}

absl::Status HttpConnection::Perform(const HttpRequest& request, const std::stop_token& stop, HttpReply* reply,
                                     const Sink& sink) {
  CURL* const easy = handles_->easy;
  CURLM* const multi = handles_->multi;
  *reply = HttpReply();
  Exchange exchange{easy, reply, &sink};
  char why[CURL_ERROR_SIZE] = "";
  HeaderList headers;
  for (const std::string& header : request.headers) headers.Add(header);
  headers.Add("Expect:");

  curl_easy_reset(easy);
  curl_easy_setopt(easy, CURLOPT_URL, request.url.c_str());
  curl_easy_setopt(easy, CURLOPT_PATH_AS_IS, 1L);
  curl_easy_setopt(easy, CURLOPT_PROTOCOLS_STR, "http,https");
  curl_easy_setopt(easy, CURLOPT_PROXY, "");  // none of the environment's either
  curl_easy_setopt(easy, CURLOPT_HTTP_VERSION, static_cast<long>(CURL_HTTP_VERSION_1_1));
  curl_easy_setopt(easy, CURLOPT_SSLVERSION, static_cast<long>(CURL_SSLVERSION_TLSv1_2));
  curl_easy_setopt(easy, CURLOPT_CAINFO, nullptr);  // nor the system's roots
  curl_easy_setopt(easy, CURLOPT_CAPATH, nullptr);
  SetBlob(easy, CURLOPT_CAINFO_BLOB, access_.ca);
  SetBlob(easy, CURLOPT_SSLCERT_BLOB, access_.client_certificate);
  SetBlob(easy, CURLOPT_SSLKEY_BLOB, access_.client_key);
  curl_easy_setopt(easy, CURLOPT_NOSIGNAL, 1L);
  curl_easy_setopt(easy, CURLOPT_QUICK_EXIT, 1L);  // a stop does not wait for a look-up of the server's name
  curl_easy_setopt(easy, CURLOPT_SOCKOPTFUNCTION, SetSocketOptions);
  curl_easy_setopt(easy, CURLOPT_CONNECTTIMEOUT_MS,
                   static_cast<long>(std::chrono::milliseconds(kConnectTimeout).count()));
  curl_easy_setopt(easy, CURLOPT_TIMEOUT_MS, static_cast<long>(std::max<int64_t>(1, request.timeout.count())));
  curl_easy_setopt(easy, CURLOPT_CUSTOMREQUEST, request.method.c_str());
  if (!request.body.empty()) {
    curl_easy_setopt(easy, CURLOPT_POSTFIELDSIZE_LARGE, static_cast<curl_off_t>(request.body.size()));
    curl_easy_setopt(easy, CURLOPT_POSTFIELDS, request.body.data());
  }
  curl_easy_setopt(easy, CURLOPT_HTTPHEADER, headers.list);
  curl_easy_setopt(easy, CURLOPT_USERAGENT, "aureole");
  curl_easy_setopt(easy, CURLOPT_WRITEFUNCTION, TakeBody);
  curl_easy_setopt(easy, CURLOPT_WRITEDATA, &exchange);
  curl_easy_setopt(easy, CURLOPT_HEADERFUNCTION, TakeHeader);
  curl_easy_setopt(easy, CURLOPT_HEADERDATA, &exchange);
  curl_easy_setopt(easy, CURLOPT_ERRORBUFFER, why);

  CURLcode code = CURLE_OK;
  bool silent = false;
  {
    const std::stop_callback wake(stop, [multi] { curl_multi_wakeup(multi); });
    const Clock::time_point silent_at = Clock::now() + request.header_timeout;
    curl_multi_add_handle(multi, easy);
    int running = 1;
    while (running > 0) {
      curl_multi_perform(multi, &running);
      silent = request.header_timeout.count() > 0 && !exchange.begun && Clock::now() >= silent_at;
      if (running == 0 || silent || stop.stop_requested()) break;
      const auto left = std::chrono::ceil<std::chrono::milliseconds>(silent_at - Clock::now()).count();
      const bool waits_for_header = request.header_timeout.count() > 0 && !exchange.begun;
      curl_multi_poll(multi, nullptr, 0, waits_for_header ? static_cast<int>(std::clamp<int64_t>(left, 1, 1000)) : 1000,
                      nullptr);
    }
    int left = 0;
    while (const CURLMsg* message = curl_multi_info_read(multi, &left)) {
      if (message->msg == CURLMSG_DONE) code = message->data.result;
    }
    curl_easy_getinfo(easy, CURLINFO_RESPONSE_CODE, &reply->status);
    curl_multi_remove_handle(multi, easy);  // closes a connection that is not idle
    reply->sent = !IsBeforeSending(code);
    if (stop.stop_requested() && (running > 0 || code != CURLE_OK)) {
      return absl::CancelledError(absl::StrCat(request.method, " ", request.url, ": stopped"));
    }
  }
  const std::string what = absl::StrCat(request.method, " ", request.url, ": ");
  if (silent) return absl::UnavailableError(absl::StrCat(what, "no reply in ", request.header_timeout.count(), " ms"));
  if (exchange.refused_by_sink) return absl::CancelledError(absl::StrCat(what, "ended by its reader"));
  if (exchange.too_large) {
    return absl::ResourceExhaustedError(absl::StrCat(what, "the reply has more than ", kMostBody, " bytes"));
  }
  if (code == CURLE_OK) return absl::OkStatus();
  const std::string reason =
      absl::StrCat(what, why[0] != '\0' ? why : curl_easy_strerror(code),
                   code == CURLE_SSL_CONNECT_ERROR ? " (TLS handshake failed; is the CA that of this server?)" : "");
  return IsIdentityError(code) ? absl::FailedPreconditionError(reason) : absl::UnavailableError(reason);
}

}  // namespace aureole::kubernetes
