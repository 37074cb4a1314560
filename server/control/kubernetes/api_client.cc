#include "server/control/kubernetes/api_client.h"

#include <algorithm>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/control/kubernetes/api_status.h"
#include "server/control/kubernetes/backoff.h"

namespace aureole::kubernetes {
namespace {

using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;

constexpr milliseconds kFirstPause{100}, kLongestPause{5000};
constexpr char kJsonType[] = "application/json";

// ?a=b&c=d of those that are not empty.
std::string Query(std::initializer_list<std::pair<const char*, std::string>> parameters) {
  std::string out;
  for (const auto& [name, value] : parameters) {
    if (!value.empty()) absl::StrAppend(&out, out.empty() ? "?" : "&", name, "=", UrlEncoded(value));
  }
  return out;
}

// The body of a refusal, whatever it is: a proxy's is HTML.
Json BodyOfRefusal(const std::string& text) {
  absl::StatusOr<Json> json = ParseJson(text);
  return json.ok() ? *std::move(json) : Json();
}

absl::Status StatusOfExchange(const std::string& what, const HttpReply& reply) {
  if (reply.status / 100 == 2) return absl::OkStatus();
  return StatusOfReply(what, reply.status, BodyOfRefusal(reply.body), reply.retry_after);
}

absl::StatusOr<WatchEvent> EventOf(const std::string& what, const std::string& line) {
  absl::StatusOr<Json> json = ParseJson(line);
  const auto object = json.ok() ? json->find("object") : Json::iterator();
  if (!json.ok() || !json->is_object() || object == json->end() || !object->is_object()) {
    return absl::DataLossError(absl::StrCat(what, ": a line of ", line.size(), " bytes is not a watch event"));
  }
  const std::string type = TextAt(*json, {"type"});
  if (type == "ERROR") {
    return StatusOfReply(absl::StrCat(what, ": ERROR event"), IntegerAt(*object, {"code"}).value_or(500), *object);
  }
  static constexpr std::pair<const char*, WatchEvent::Kind> kKinds[] = {{"ADDED", WatchEvent::Kind::kAdded},
                                                                        {"MODIFIED", WatchEvent::Kind::kModified},
                                                                        {"DELETED", WatchEvent::Kind::kDeleted},
                                                                        {"BOOKMARK", WatchEvent::Kind::kBookmark}};
  for (const auto& [name, kind] : kKinds) {
    if (type == name) return WatchEvent{kind, std::move(*object)};
  }
  return absl::DataLossError(absl::StrCat(what, ": a watch event of type '", type, "'"));
}

}  // namespace

ApiClient::ApiClient(ClusterAccess access) : access_(std::move(access)), token_(access_.token, access_.token_file) {}

ApiClient::~ApiClient() = default;

ApiStats ApiClient::stats() const { return {requests_, repeated_, tokens_renewed_, refused_}; }

absl::StatusOr<Json> ApiClient::Get(const Resource& resource, const std::string& name, const CallOptions& options) {
  const absl::StatusOr<std::string> path = resource.ObjectPath(name);
  if (!path.ok()) return path.status();
  return Call({.method = "GET", .path = *path, .repeatable = true}, options);
}

absl::StatusOr<std::string> ApiClient::Log(const std::string& space, const std::string& pod, int lines,
                                           const CallOptions& options) {
  const absl::StatusOr<std::string> path = Resource{"", "v1", "pods", space, "log"}.ObjectPath(pod);
  if (!path.ok()) return path.status();
  HttpRequest request{.method = "GET",
                      .url = absl::StrCat(access_.server, *path, Query({{"tailLines", absl::StrCat(lines)}})),
                      .headers = {"Accept: */*"},
                      .timeout = std::min(options.timeout, options.attempt_timeout)};
  HttpReply reply;
  if (absl::Status s = Exchange(&request, options.stop, &reply, nullptr); !s.ok()) return s;
  if (absl::Status s = StatusOfExchange("GET " + *path, reply); !s.ok()) return s;
  return std::move(reply.body);
}

absl::StatusOr<ObjectList> ApiClient::List(const Resource& resource, const Selection& selection,
                                           const CallOptions& options) {
  ObjectList out;
  std::string limit = absl::StrCat(kPage), next;
  while (true) {
    absl::StatusOr<Json> page = Call({.method = "GET",
                                      .path = resource.CollectionPath() + Query({{"labelSelector", selection.labels},
                                                                                 {"fieldSelector", selection.fields},
                                                                                 {"limit", limit},
                                                                                 {"continue", next}}),
                                      .repeatable = true},
                                     options);
    if (absl::IsOutOfRange(page.status()) && !next.empty()) {
      out.items.clear();
      next.clear();
      limit.clear();
      continue;
    }
    if (!page.ok()) return page.status();
    const auto items = page->find("items");
    out.resource_version = TextAt(*page, {"metadata", "resourceVersion"});
    if (items == page->end() || !(items->is_array() || items->is_null()) || out.resource_version.empty()) {
      return absl::DataLossError(absl::StrCat(resource.CollectionPath(), ": the reply is not a list"));
    }
    for (Json& item : *items) out.items.push_back(std::move(item));
    next = TextAt(*page, {"metadata", "continue"});
    if (next.empty()) return out;
  }
}

absl::StatusOr<Json> ApiClient::Create(const Resource& resource, const Json& object, const CallOptions& options) {
  std::string path = resource.CollectionPath();
  if (!resource.subresource.empty()) {  // pods/NAME/eviction
    absl::StatusOr<std::string> of_object = resource.ObjectPath(TextAt(object, {"metadata", "name"}));
    if (!of_object.ok()) return of_object;
    path = *std::move(of_object);
  }
  return Call({.method = "POST", .path = path, .body = ToText(object), .content_type = kJsonType}, options);
}

absl::StatusOr<Json> ApiClient::Replace(const Resource& resource, const Json& object, const CallOptions& options) {
  const absl::StatusOr<std::string> path = resource.ObjectPath(TextAt(object, {"metadata", "name"}));
  if (!path.ok()) return path.status();
  if (TextAt(object, {"metadata", "resourceVersion"}).empty()) {
    return absl::InvalidArgumentError(
        absl::StrCat(*path, ": metadata.resourceVersion: missing; replace what was read"));
  }
  return Call({.method = "PUT", .path = *path, .body = ToText(object), .content_type = kJsonType, .repeatable = true},
              options);
}

absl::StatusOr<Json> ApiClient::Patch(const Resource& resource, const std::string& name, const kubernetes::Patch& patch,
                                      const CallOptions& options) {
  using Kind = kubernetes::Patch::Kind;
  const absl::StatusOr<std::string> path = resource.ObjectPath(name);
  if (!path.ok()) return path.status();
  if (patch.kind == Kind::kApply && patch.field_manager.empty()) {
    return absl::InvalidArgumentError(absl::StrCat(*path, ": field_manager: missing; server-side apply needs one"));
  }
  const char* const type = patch.kind == Kind::kMerge  ? "application/merge-patch+json"
                           : patch.kind == Kind::kJson ? "application/json-patch+json"
                                                       : "application/apply-patch+yaml";
  return Call({.method = "PATCH",
               .path = *path + Query({{"fieldManager", patch.field_manager},
                                      {"force", patch.kind == Kind::kApply && patch.force ? "true" : ""}}),
               .body = ToText(patch.body),
               .content_type = type,
               .repeatable = patch.kind != Kind::kJson},
              options);
}

absl::Status ApiClient::Delete(const Resource& resource, const std::string& name, const DeleteOptions& what,
                               const CallOptions& options) {
  const absl::StatusOr<std::string> path = resource.ObjectPath(name);
  if (!path.ok()) return path.status();
  Json body = {{"apiVersion", "v1"}, {"kind", "DeleteOptions"}, {"propagationPolicy", what.propagation}};
  if (!what.uid.empty()) body["preconditions"]["uid"] = what.uid;
  if (!what.resource_version.empty()) body["preconditions"]["resourceVersion"] = what.resource_version;
  if (what.grace_period_seconds) body["gracePeriodSeconds"] = *what.grace_period_seconds;
  return Call({.method = "DELETE",
               .path = *path,
               .body = ToText(body),
               .content_type = kJsonType,
               .repeatable = !what.uid.empty() || !what.resource_version.empty()},
              options)
      .status();
}

absl::StatusOr<Json> ApiClient::Call(const Request& request, const CallOptions& options) {
  const Clock::time_point deadline = Clock::now() + options.timeout;
  Backoff backoff(kFirstPause, kLongestPause);
  for (int attempt = 1;; ++attempt) {
    const auto left = std::chrono::duration_cast<milliseconds>(deadline - Clock::now());
    bool acted_on = false;
    absl::StatusOr<Json> reply = CallOnce(request, std::min(left, options.attempt_timeout), options.stop, &acted_on);
    if (absl::IsInvalidArgument(reply.status())) ++refused_;
    if (!absl::IsUnavailable(reply.status()) || attempt >= options.attempts || (acted_on && !request.repeatable)) {
      return reply;
    }
    const milliseconds pause = RetryAfterOf(reply.status()).value_or(std::chrono::seconds(0));
    const milliseconds wait = std::max(pause, backoff.Next());
    if (Clock::now() + wait >= deadline) return reply;
    if (!Pause(options.stop, wait)) return absl::CancelledError(absl::StrCat(request.path, ": stopped"));
    ++repeated_;
  }
}

absl::StatusOr<Json> ApiClient::CallOnce(const Request& request, milliseconds timeout, const std::stop_token& stop,
                                         bool* acted_on) {
  HttpRequest http{.method = request.method,
                   .url = access_.server + request.path,
                   .headers = {"Accept: application/json"},
                   .body = request.body,
                   .timeout = timeout};
  if (!request.content_type.empty()) http.headers.push_back("Content-Type: " + request.content_type);
  HttpReply reply;
  absl::Status exchanged = Exchange(&http, stop, &reply, nullptr);
  *acted_on = reply.sent && reply.status != 429;
  if (!exchanged.ok()) return exchanged;
  const std::string what = absl::StrCat(request.method, " ", request.path);
  if (absl::Status s = StatusOfExchange(what, reply); !s.ok()) return s;
  absl::StatusOr<Json> json = ParseJson(reply.body);
  if (!json.ok()) return absl::UnavailableError(absl::StrCat(what, ": ", json.status().message()));
  if (!json->is_object()) return absl::UnavailableError(absl::StrCat(what, ": the reply is not an object"));
  return json;
}

absl::Status ApiClient::Exchange(HttpRequest* request, const std::stop_token& stop, HttpReply* reply,
                                 const HttpConnection::Sink& sink) {
  std::unique_ptr<HttpConnection> connection = TakeConnection();
  absl::Status status;
  for (const bool may_renew : {true, false}) {
    const absl::StatusOr<std::string> token = token_.Get();
    if (!token.ok()) return token.status();
    HttpRequest with_token = *request;
    if (!token->empty()) with_token.headers.push_back(absl::StrCat("Authorization: Bearer ", *token));
    ++requests_;
    status = connection->Perform(with_token, stop, reply, sink);
    if (!status.ok() || reply->status != 401 || !may_renew || !token_.RenewAfterRefusal(*token)) break;
    ++tokens_renewed_;
  }
  if (status.ok()) GiveBack(std::move(connection));
  return status;
}

absl::Status ApiClient::Watch(const Resource& resource, const Selection& selection, const std::string& resource_version,
                              const WatchOptions& options, const std::function<absl::Status(WatchEvent)>& take) {
  const std::string path = resource.CollectionPath();
  HttpRequest request{.method = "GET",
                      .url = absl::StrCat(access_.server, path,
                                          Query({{"watch", "1"},
                                                 {"resourceVersion", resource_version},
                                                 {"allowWatchBookmarks", "true"},
                                                 {"timeoutSeconds", absl::StrCat(options.timeout.count())},
                                                 {"labelSelector", selection.labels},
                                                 {"fieldSelector", selection.fields}})),
                      .headers = {"Accept: application/json"},
                      .timeout = options.timeout + options.grace,
                      .header_timeout = options.grace};
  const std::string what = absl::StrCat("watch ", path);
  absl::Status taken;
  std::string line;  // the part that has come
  HttpReply reply;
  absl::Status exchanged = Exchange(&request, options.stop, &reply, [&](const char* part, size_t bytes) {
    if (bytes == 0) options.opened();
    const char* const end = part + bytes;
    while (taken.ok() && part != end) {
      const char* const newline = std::find(part, end, '\n');
      line.append(part, newline);
      if (newline == end) break;
      part = newline + 1;
      absl::StatusOr<WatchEvent> event = EventOf(what, line);
      line.clear();
      taken = event.ok() ? take(*std::move(event)) : event.status();
    }
    if (line.size() > kMostLine) {
      taken = absl::ResourceExhaustedError(absl::StrCat(what, ": an event has more than ", kMostLine, " bytes"));
    }
    return taken.ok();
  });
  if (!taken.ok()) return taken;
  if (!exchanged.ok()) return exchanged;
  if (absl::Status s = StatusOfExchange(what, reply); !s.ok()) return s;
  // A reply may end in the middle of a line and still be complete to HTTP: a proxy may have cut it.
  return line.empty() ? absl::OkStatus() : absl::UnavailableError(what + ": ended within an event");
}

std::unique_ptr<HttpConnection> ApiClient::TakeConnection() {
  const std::lock_guard lock(mutex_);
  if (idle_.empty()) return std::make_unique<HttpConnection>(access_);
  std::unique_ptr<HttpConnection> connection = std::move(idle_.back());
  idle_.pop_back();
  return connection;
}

void ApiClient::GiveBack(std::unique_ptr<HttpConnection> connection) {
  const std::lock_guard lock(mutex_);
  idle_.push_back(std::move(connection));
}

}  // namespace aureole::kubernetes
