#include "tests/kubernetes/fake_api_server.h"

#include <algorithm>
#include <utility>

#include <absl/strings/match.h>
#include <absl/strings/numbers.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_split.h>

#include "server/core/check.h"

namespace aureole::kubernetes {
namespace {

constexpr int64_t kTop = 1'000'000'000;

Json StatusObject(int code, const std::string& reason, const std::string& message) {
  return {{"kind", "Status"}, {"apiVersion", "v1"}, {"status", code == 200 ? "Success" : "Failure"},
          {"reason", reason}, {"message", message}, {"code", code}};
}

const char* ReasonOfCode(int code) {
  switch (code) {
    case 401:
      return "Unauthorized";
    case 403:
      return "Forbidden";
    case 404:
      return "NotFound";
    case 409:
      return "Conflict";
    case 410:
      return "Expired";
    case 422:
      return "Invalid";
    case 429:
      return "TooManyRequests";
    case 503:
      return "ServiceUnavailable";
    default:
      return "InternalError";
  }
}

std::string EventLine(const std::string& type, const Json& object) {
  return Json({{"type", type}, {"object", object}}).dump() + "\n";
}

bool HasLabels(const Json& object, const std::string& selector) {
  for (const auto term : absl::StrSplit(selector, ',', absl::SkipEmpty())) {
    const std::pair<std::string, std::string> wanted = absl::StrSplit(term, absl::MaxSplits('=', 1));
    if (TextAt(object, {"metadata", "labels", wanted.first.c_str()}) != wanted.second) return false;
  }
  return true;
}

}  // namespace

FakeApiServer::FakeApiServer(const TlsKeys* keys) : keys_(keys) { Start(); }

FakeApiServer::~FakeApiServer() { Stop(); }

ClusterAccess FakeApiServer::Access() const {
  ClusterAccess access;
  access.server = url();
  access.space = "test";
  if (keys_ != nullptr) {
    access.ca = keys_->ca;
    access.client_certificate = keys_->client_certificate;
    access.client_key = keys_->client_key;
  }
  return access;
}

std::string FakeApiServer::url() const {
  return absl::StrCat(keys_ == nullptr ? "http" : "https", "://127.0.0.1:", port_);
}

void FakeApiServer::Stop() {
  if (server_ == nullptr) return;
  {
    const std::lock_guard lock(mutex_);
    stopping_ = true;
  }
  changed_.notify_all();
  server_->stop();
  thread_.join();
  server_.reset();
}

void FakeApiServer::Start() {
  {
    const std::lock_guard lock(mutex_);
    stopping_ = false;
  }
  if (keys_ == nullptr) {
    server_ = std::make_unique<httplib::Server>();
  } else {
    server_ = keys_->NewServer();
  }
  server_->new_task_queue = [] { return new httplib::ThreadPool(32); };  // a connection holds a thread
  server_->set_keep_alive_timeout(1);
  const httplib::Server::Handler handler = [this](const httplib::Request& request, httplib::Response& response) {
    Handle(request, response);
  };
  server_->Get(".*", handler).Post(".*", handler).Put(".*", handler).Patch(".*", handler).Delete(".*", handler);
  if (port_ == 0) {
    port_ = server_->bind_to_any_port("127.0.0.1");
    AUREOLE_CHECK(port_ > 0, "no port");
  } else {
    AUREOLE_CHECK(server_->bind_to_port("127.0.0.1", port_), "port %d", port_);
  }
  thread_ = std::thread([this] { server_->listen_after_bind(); });
  // Stop before it listens would be lost.
  while (!server_->is_running()) std::this_thread::yield();
}

void FakeApiServer::AcceptOnly(const std::string& token) {
  const std::lock_guard lock(mutex_);
  token_ = token;
}

void FakeApiServer::Inject(Fault fault) {
  const std::lock_guard lock(mutex_);
  faults_.push_back(std::move(fault));
}

void FakeApiServer::Release() {
  {
    const std::lock_guard lock(mutex_);
    ++releases_;
    std::erase_if(faults_, [](const Fault& fault) { return fault.kind == Fault::Kind::kHang; });
  }
  changed_.notify_all();
}

size_t FakeApiServer::faults_left() const {
  const std::lock_guard lock(mutex_);
  return faults_.size();
}

void FakeApiServer::CutWatches() {
  {
    const std::lock_guard lock(mutex_);
    ++cuts_;
  }
  changed_.notify_all();
}

void FakeApiServer::ForgetHistory() {
  const std::lock_guard lock(mutex_);
  // An event of another kind, so that what was listed last is too old as well.
  forgotten_ = ++version_;
  pages_.clear();
}

void FakeApiServer::SendBookmarks() {
  {
    const std::lock_guard lock(mutex_);
    ++version_;
    ++bookmarks_;
  }
  changed_.notify_all();
}

Json FakeApiServer::Put(const std::string& path, Json object) {
  const Place place = Parse(path).value();
  const std::lock_guard lock(mutex_);
  const auto found = objects_.find(KeyOf(place));
  if (found != objects_.end()) object["metadata"]["uid"] = found->second.second["metadata"]["uid"];
  return Store(place, std::move(object), found == objects_.end() ? "ADDED" : "MODIFIED");
}

Json FakeApiServer::Merge(const std::string& path, const Json& patch) {
  const Place place = Parse(path).value();
  const std::lock_guard lock(mutex_);
  const auto found = objects_.find(KeyOf(place));
  if (found == objects_.end()) return nullptr;
  Json object = found->second.second;
  object.merge_patch(patch);
  return Store(place, std::move(object), "MODIFIED");
}

void FakeApiServer::PutLog(const std::string& pod, const std::string& text) {
  const std::lock_guard lock(mutex_);
  logs_[KeyOf(Parse(pod).value())] = text;
}

void FakeApiServer::Remove(const std::string& path) {
  const Place place = Parse(path).value();
  const std::lock_guard lock(mutex_);
  const auto found = objects_.find(KeyOf(place));
  if (found != objects_.end()) Store(place, found->second.second, "DELETED");
}

std::optional<Json> FakeApiServer::At(const std::string& path) const {
  const std::lock_guard lock(mutex_);
  const auto found = objects_.find(KeyOf(Parse(path).value()));
  if (found == objects_.end()) return std::nullopt;
  return found->second.second;
}

std::vector<Json> FakeApiServer::All(const std::string& collection) const {
  const Place wanted = Parse(collection).value();
  const std::lock_guard lock(mutex_);
  std::vector<Json> out;
  for (const auto& [key, stored] : objects_) {
    if (Matches(wanted, stored.first)) out.push_back(stored.second);
  }
  return out;
}

int FakeApiServer::Count(const std::string& text) const {
  const std::lock_guard lock(mutex_);
  return static_cast<int>(std::count_if(requests_.begin(), requests_.end(),
                                        [&](const std::string& line) { return absl::StrContains(line, text); }));
}

int FakeApiServer::watches() const {
  const std::lock_guard lock(mutex_);
  return watches_;
}

std::optional<FakeApiServer::Place> FakeApiServer::Parse(const std::string& path) {
  std::vector<std::string> parts = absl::StrSplit(path, '/', absl::SkipEmpty());
  const size_t head = !parts.empty() && parts[0] == "api" ? 2 : 3;  // api/v1, apis/group/version
  if (parts.size() <= head) return std::nullopt;
  Place place;
  size_t i = head;
  if (parts[i] == "namespaces" && parts.size() > i + 2) {
    place.space = parts[i + 1];
    i += 2;
  }
  for (size_t h = 0; h < head; ++h) absl::StrAppend(&place.collection, "/", parts[h]);
  absl::StrAppend(&place.collection, "/", parts[i++]);
  if (i < parts.size()) place.name = parts[i++];
  if (i < parts.size()) place.subresource = parts[i++];
  return place;
}

std::string FakeApiServer::KeyOf(const Place& place) {
  return absl::StrCat(place.collection, "|", place.space, "|", place.name);
}

// Falling, so that who orders versions goes wrong.
std::string FakeApiServer::Written(int64_t version) { return absl::StrCat(kTop - version); }

std::optional<int64_t> FakeApiServer::VersionOf(const std::string& text) {
  int64_t number = 0;
  if (!absl::SimpleAtoi(text, &number)) return std::nullopt;
  return kTop - number;
}

bool FakeApiServer::Matches(const Place& wanted, const Place& place) const {
  return wanted.collection == place.collection && (wanted.space.empty() || wanted.space == place.space);
}

// Holds the mutex.
Json FakeApiServer::Store(const Place& place, Json object, const char* type) {
  Json& metadata = object["metadata"];
  metadata["name"] = place.name;
  if (!place.space.empty()) metadata["namespace"] = place.space;
  if (!metadata.contains("uid")) metadata["uid"] = absl::StrCat("uid-", next_uid_++);
  metadata["resourceVersion"] = Written(++version_);
  const auto before = objects_.find(KeyOf(place));
  const bool there = before != objects_.end();
  const bool same = there && before->second.second.value("spec", Json()) == object.value("spec", Json());
  metadata["generation"] =
      (there ? IntegerAt(before->second.second, {"metadata", "generation"}).value_or(0) : 0) + (same ? 0 : 1);
  Place of = place;
  of.subresource.clear();
  history_.push_back({version_, of, type, object});
  if (std::string(type) == "DELETED") {
    objects_.erase(KeyOf(place));
  } else {
    objects_[KeyOf(place)] = {of, object};
  }
  changed_.notify_all();
  return object;
}

std::optional<Fault> FakeApiServer::TakeFault(const httplib::Request& request) {
  for (auto it = faults_.begin(); it != faults_.end(); ++it) {
    if (it->method != request.method || !absl::StrContains(request.target, it->target) ||
        !absl::StrContains(request.body, it->body)) {
      continue;
    }
    Fault fault = *it;
    if (--it->times == 0) faults_.erase(it);
    return fault;
  }
  return std::nullopt;
}

void FakeApiServer::Refuse(httplib::Response& response, int code, const std::string& reason,
                           const std::string& message) {
  response.status = code;
  response.set_content(StatusObject(code, reason, message).dump(), "application/json");
}

void FakeApiServer::Handle(const httplib::Request& request, httplib::Response& response) {
  using Kind = Fault::Kind;
  std::unique_lock lock(mutex_);
  requests_.push_back(request.method + " " + request.target);
  if (!token_.empty() && request.get_header_value("Authorization") != "Bearer " + token_) {
    return Refuse(response, 401, "Unauthorized", "Unauthorized");
  }
  const std::optional<Fault> fault = TakeFault(request);
  if (fault && fault->kind == Kind::kStatus) {
    if (fault->retry_after >= 0) response.set_header("Retry-After", std::to_string(fault->retry_after));
    return Refuse(response, fault->status, fault->reason.empty() ? ReasonOfCode(fault->status) : fault->reason,
                  fault->message);
  }
  if (fault && fault->kind == Kind::kSlow) changed_.wait_for(lock, fault->delay, [this] { return stopping_; });
  if (fault && fault->kind == Kind::kHang) {
    changed_.wait(lock, [this, before = releases_] { return stopping_ || releases_ != before; });
    return Refuse(response, 503, "ServiceUnavailable", "hung");
  }
  const std::optional<Place> place = Parse(request.path);
  if (!place) return Refuse(response, 404, "NotFound", "the server could not find the requested resource");
  if (request.has_param("watch")) return Watch(request, *place, fault, response);
  Answer(request, *place, response);
  const auto body = std::make_shared<std::string>(response.body);
  if (fault && fault->kind == Kind::kBrokenJson) response.body.pop_back();
  if (!fault || fault->kind != Kind::kLostReply) return;
  response.body.clear();
  response.set_content_provider(body->size(), "application/json", [body](size_t, size_t, httplib::DataSink& sink) {
    sink.write(body->data(), body->size() / 2);
    return false;
  });
}

void FakeApiServer::Answer(const httplib::Request& request, const Place& place, httplib::Response& response) {
  const std::string& method = request.method;
  const Json body = request.body.empty() ? Json::object() : Json::parse(request.body, nullptr, false);
  if (body.is_discarded()) return Refuse(response, 400, "BadRequest", "the body is not JSON");
  if (place.name.empty() && method == "GET") return List(request, place, response);
  Place at = place;
  if (method == "POST") at.name = TextAt(body, {"metadata", "name"});
  if (at.name.empty()) return Refuse(response, 405, "MethodNotAllowed", "of a collection");
  const auto found = objects_.find(KeyOf(at));
  const bool there = found != objects_.end();
  const std::string type = request.get_header_value("Content-Type");
  const bool apply = method == "PATCH" && type == "application/apply-patch+yaml";
  if (method == "POST" && there) return Refuse(response, 409, "AlreadyExists", at.name + " already exists");
  if (method != "POST" && !apply && !there) return Refuse(response, 404, "NotFound", at.name + " not found");
  if (apply && !request.has_param("fieldManager")) return Refuse(response, 400, "BadRequest", "fieldManager");

  const Json now = there ? found->second.second : Json::object();
  if (method == "GET" && place.subresource == "log") return response.set_content(logs_[KeyOf(at)], "text/plain");
  if (method == "GET") return response.set_content(now.dump(), "application/json");
  const std::string uid = TextAt(now, {"metadata", "uid"}), version = TextAt(now, {"metadata", "resourceVersion"});
  const auto conflicts = [](const std::string& wanted, const std::string& is) {
    return !wanted.empty() && wanted != is;
  };
  if (method == "DELETE") {
    if (conflicts(TextAt(body, {"preconditions", "uid"}), uid) ||
        conflicts(TextAt(body, {"preconditions", "resourceVersion"}), version)) {
      return Refuse(response, 409, "Conflict", "the precondition does not hold");
    }
    const int64_t grace = IntegerAt(body, {"gracePeriodSeconds"}).value_or(30);
    if (grace > 0 && !TextAt(now, {"spec", "nodeName"}).empty()) {  // a kubelet has to end it first
      Json leaving = now;
      leaving["metadata"]["deletionTimestamp"] = "2026-01-01T00:00:00Z";
      leaving["metadata"]["deletionGracePeriodSeconds"] = grace;
      const Json stored = Store(at, std::move(leaving), "MODIFIED");
      return response.set_content(stored.dump(), "application/json");
    }
    Store(at, now, "DELETED");
    response.set_content(StatusObject(200, "", "").dump(), "application/json");
    return;
  }
  Json next = body;
  if (method == "PATCH" && type == "application/json-patch+json") {
    try {
      next = now.patch(body);
    } catch (const Json::exception& e) {
      return Refuse(response, 422, "Invalid", e.what());
    }
  } else if (method == "PATCH") {
    if (!apply && type != "application/merge-patch+json") return Refuse(response, 415, "UnsupportedMediaType", type);
    next = now;
    next.merge_patch(body);
  }
  const std::string based_on = TextAt(method == "PATCH" ? body : next, {"metadata", "resourceVersion"});
  if (there && conflicts(based_on, version)) return Refuse(response, 409, "Conflict", "the object has been modified");
  // The status is written through its subresource only, and through that nothing else.
  if (place.subresource == "status") {
    Json whole = now;
    whole["status"] = next.value("status", Json());
    next = whole;
  } else if (there && now.contains("status")) {
    next["status"] = now["status"];
  } else {
    next.erase("status");
  }
  if (there) next["metadata"]["uid"] = uid;
  at.subresource.clear();
  const Json stored = Store(at, std::move(next), there ? "MODIFIED" : "ADDED");
  response.status = there ? 200 : 201;
  response.set_content(stored.dump(), "application/json");
}

void FakeApiServer::List(const httplib::Request& request, const Place& place, httplib::Response& response) {
  std::vector<Json> items;
  std::string token = request.get_param_value("continue");
  std::string version = Written(version_);
  if (!token.empty()) {
    const auto page = pages_.find(token);
    if (page == pages_.end()) return Refuse(response, 410, "Expired", "the continue token is too old");
    items = page->second;
    version = token.substr(0, token.find('-'));
  } else {
    for (const auto& [key, stored] : objects_) {
      if (Matches(place, stored.first) && HasLabels(stored.second, request.get_param_value("labelSelector"))) {
        items.push_back(stored.second);
      }
    }
  }
  size_t limit = 0;
  Json list = {{"kind", "List"}, {"apiVersion", "v1"}, {"metadata", {{"resourceVersion", version}}}};
  if (absl::SimpleAtoi(request.get_param_value("limit"), &limit) && limit > 0 && items.size() > limit) {
    const std::string next = absl::StrCat(version, "-", items.size() - limit);
    pages_[next] = std::vector<Json>(items.begin() + static_cast<std::ptrdiff_t>(limit), items.end());
    list["metadata"]["continue"] = next;
    items.resize(limit);
  }
  list["items"] = items;
  response.set_content(list.dump(), "application/json");
}

void FakeApiServer::Watch(const httplib::Request& request, const Place& place, std::optional<Fault> fault,
                          httplib::Response& response) {
  using Kind = Fault::Kind;
  const std::optional<int64_t> from = VersionOf(request.get_param_value("resourceVersion"));
  if (!from || *from > version_) return Refuse(response, 400, "BadRequest", "resourceVersion");
  if (*from < forgotten_) return Refuse(response, 410, "Expired", "too old resource version");
  int64_t seconds = 0;
  if (!absl::SimpleAtoi(request.get_param_value("timeoutSeconds"), &seconds)) seconds = 1800;
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(seconds);
  const std::string labels = request.get_param_value("labelSelector");

  struct Cursor {
    int64_t at = 0;
    int cuts = 0, bookmarks = 0, releases = 0;
  };
  auto cursor = std::make_shared<Cursor>(Cursor{*from, cuts_, bookmarks_, releases_});
  ++watches_;
  // Called again and again until it says that it is done, or fails, which cuts the connection.
  const auto provide = [=, this](size_t, httplib::DataSink& sink) mutable {
    std::string out;
    bool ends = false, cut = false;
    {
      std::unique_lock lock(mutex_);
      const auto next = [&] {
        return std::find_if(history_.begin(), history_.end(), [&](const Entry& entry) {
          return entry.version > cursor->at && Matches(place, entry.place) && HasLabels(entry.object, labels);
        });
      };
      if (fault && (fault->kind == Kind::kGoneEvent || fault->kind == Kind::kErrorEvent)) {
        const int code = fault->kind == Kind::kGoneEvent ? 410 : fault->status;
        out = EventLine("ERROR", StatusObject(code, ReasonOfCode(code), "injected"));
        ends = true;
      } else if (fault && fault->kind == Kind::kGarbageLine) {
        out = "<html>\n";
        fault.reset();
      } else {
        const bool mute = fault && fault->kind == Kind::kMute;
        if (mute) changed_.wait(lock, [&] { return stopping_ || releases_ != cursor->releases; });
        changed_.wait_until(lock, end, [&] {
          return mute || stopping_ || cursor->cuts != cuts_ || cursor->bookmarks != bookmarks_ ||
                 next() != history_.end();
        });
        if (mute || stopping_ || cursor->cuts != cuts_) {
          cut = true;
        } else if (const auto entry = next(); entry != history_.end()) {
          out = EventLine(entry->type, entry->object);
          cursor->at = entry->version;
        } else if (cursor->bookmarks != bookmarks_) {
          cursor->bookmarks = bookmarks_;
          cursor->at = version_;
          out = EventLine("BOOKMARK", {{"kind", "X"}, {"metadata", {{"resourceVersion", Written(version_)}}}});
        } else {
          ends = true;
        }
      }
    }
    if (fault && fault->kind == Kind::kHalfLine && !out.empty()) {
      out.resize(out.size() / 2);
      cut = true;
    }
    if (!out.empty() && !sink.write(out.data(), out.size())) return false;
    if (ends) sink.done();
    return !cut;
  };
  response.set_chunked_content_provider("application/json", provide, [this](bool) {
    const std::lock_guard lock(mutex_);
    --watches_;
  });
}

}  // namespace aureole::kubernetes
