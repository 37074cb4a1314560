#include "server/control/kubernetes/status_store.h"

#include <google/protobuf/util/json_util.h>

#include <algorithm>
#include <utility>

#include <absl/strings/str_cat.h>
#include <absl/time/clock.h>
#include <absl/time/time.h>

#include "server/control/kubernetes/api_status.h"
#include "server/control/kubernetes/backoff.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;

constexpr milliseconds kLoadTimeout{20000};
constexpr char kEpoch[] = "controlEpoch", kRecord[] = "record", kConditions[] = "conditions";

CallOptions Once(const std::stop_token& stop) {
  return {.timeout = milliseconds(5000), .attempt_timeout = milliseconds(5000), .attempts = 1, .stop = stop};
}

// A merge patch that puts the values of `fields` in the place of those in `there`, instead of merging into them.
Json Replacing(const Json& there, const Json& fields) {
  Json patch = fields;
  for (auto& [key, value] : patch.items()) {
    const auto before = there.find(key);
    if (before == there.end() || !before->is_object() || !value.is_object()) continue;
    for (const auto& [name, old] : before->items()) {
      if (!value.contains(name)) value[name] = nullptr;
    }
  }
  return patch;
}

std::string Now() { return absl::FormatTime("%Y-%m-%dT%H:%M:%SZ", absl::Now(), absl::UTCTimeZone()); }

}  // namespace

StatusStore::StatusStore(ApiClient* client, Options options)
    : client_(client),
      options_(std::move(options)),
      worlds_(WorldsOf(options_.space)),
      statuses_(worlds_.Sub("status")),
      thread_([this](const std::stop_token& stop) { Run(stop); }) {}

StatusStore::~StatusStore() {
  Close();
  if (thread_.joinable()) thread_.join();
}

void StatusStore::Close() {
  {
    const std::lock_guard lock(mutex_);
    closed_ = true;
  }
  thread_.request_stop();
  changed_.notify_all();
}

absl::StatusOr<std::optional<v1::WorldRecord>> StatusStore::Load() {
  const auto give_up = Clock::now() + kLoadTimeout;
  Backoff backoff(options_.first_pause, options_.longest_pause);
  while (true) {
    const absl::Status s = Read(thread_.get_stop_token());
    if (s.ok()) break;
    if (absl::IsAborted(s) || Clock::now() > give_up || !Pause(thread_.get_stop_token(), backoff.Next())) return s;
  }
  Json found;
  {
    const std::lock_guard lock(mutex_);
    found = there_.value(kRecord, Json());
  }
  if (found.is_null()) return std::nullopt;
  google::protobuf::util::JsonParseOptions options;
  options.ignore_unknown_fields = true;  // of newer control planes
  v1::WorldRecord record;
  if (const auto s = google::protobuf::util::JsonStringToMessage(ToText(found), &record, options); !s.ok()) {
    return absl::DataLossError(absl::StrCat("status.record: ", s.message().as_string()));
  }
  return record;
}

absl::Status StatusStore::Save(const v1::WorldRecord& record) {
  std::string text;
  if (const auto s = google::protobuf::util::MessageToJsonString(record, &text); !s.ok()) {
    return absl::InternalError(s.message().as_string());
  }
  absl::StatusOr<Json> json = ParseJson(text);
  return json.ok() ? SaveText(*std::move(json)) : json.status();
}

absl::Status StatusStore::Forget() { return SaveText(nullptr); }

absl::Status StatusStore::SaveText(Json record) {
  std::unique_lock lock(mutex_);
  if (!lost_.ok()) return lost_;
  record_ = std::move(record);
  record_refused_ = absl::OkStatus();
  changed_.notify_all();
  changed_.wait(lock, [this] { return !record_ || !lost_.ok() || closed_; });
  if (!lost_.ok()) return lost_;
  if (!record_refused_.ok()) return record_refused_;
  return record_ ? absl::CancelledError("the record is not written: the control plane ends") : absl::OkStatus();
}

Json StatusStore::there() const {
  const std::lock_guard lock(mutex_);
  return there_;
}

void StatusStore::Publish(const WorldStatus& status) {
  {
    const std::lock_guard lock(mutex_);
    wanted_.generation = status.generation;
    wanted_.fields.update(status.fields);
    for (const Condition& condition : status.conditions) {
      const auto same = std::find_if(wanted_.conditions.begin(), wanted_.conditions.end(),
                                     [&](const Condition& other) { return other.type == condition.type; });
      if (same == wanted_.conditions.end()) {
        wanted_.conditions.push_back(condition);
      } else {
        *same = condition;
      }
    }
    dirty_ = true;
  }
  changed_.notify_all();
}

bool StatusStore::Flush(milliseconds at_most) {
  std::unique_lock lock(mutex_);
  return changed_.wait_for(lock, at_most, [this] { return !dirty_ && !record_ && !writing_; });
}

void StatusStore::Run(const std::stop_token& stop) {
  Backoff backoff(options_.first_pause, options_.longest_pause);
  Backoff refusals(options_.first_refusal, options_.longest_refusal);
  std::string told;
  Clock::time_point next;  // for what people see
  while (!stop.stop_requested()) {
    {
      std::unique_lock lock(mutex_);
      changed_.wait(lock, stop, [this] { return (record_ || dirty_) && lost_.ok(); });
      changed_.wait_until(lock, stop, next, [this] { return record_.has_value(); });
      if (stop.stop_requested()) return;
      writing_ = true;
    }
    absl::Status s = Write(What::kAll, stop);
    next = Clock::now() + options_.interval;
    const bool refused = absl::IsInvalidArgument(s);
    if (refused || absl::IsPermissionDenied(s)) {
      const std::string why(s.message());
      if (told != why) options_.refused(why);
      told = why;
    } else if (s.ok()) {
      told.clear();
      refusals.Reset();
    }
    // Nobody asks for the same again and again, but the run does not wait for what people see.
    if (refused) {
      next = Clock::now() + refusals.Next();
      s = Write(What::kRecord, stop);
    }
    {
      const std::lock_guard lock(mutex_);
      writing_ = false;
      if (absl::IsInvalidArgument(s)) {
        record_refused_ = s;
        record_.reset();
      }
      if (absl::IsAborted(s)) lost_ = s;
      if (!lost_.ok()) dirty_ = false;
    }
    changed_.notify_all();
    if (s.ok() || absl::IsAborted(s) || absl::IsInvalidArgument(s)) {
      backoff.Reset();
      continue;
    }
    const milliseconds asked = RetryAfterOf(s).value_or(std::chrono::seconds(0));
    if (!Pause(stop, std::max(asked, backoff.Next()))) return;
  }
}

Json StatusStore::Missing(What what, const std::string& now) const {
  Json wanted = Json::object();
  if (what == What::kAll) {
    wanted = wanted_.fields;
    if (wanted_.generation > 0) wanted["observedGeneration"] = wanted_.generation;
    wanted[kConditions] = ConditionList(there_.value(kConditions, Json()), wanted_, now);
  }
  wanted[kEpoch] = options_.epoch;
  if (record_) wanted[kRecord] = *record_;
  Json missing = Json::object();
  for (const auto& [key, value] : wanted.items()) {
    const auto found = there_.find(key);
    if (found == there_.end() ? !value.is_null() : *found != value) missing[key] = value;
  }
  return missing;
}

// One try, and another one at once when the World has changed meanwhile.
absl::Status StatusStore::Write(What what, const std::stop_token& stop) {
  while (true) {
    bool known = false;
    {
      const std::lock_guard lock(mutex_);
      known = !version_.empty();
    }
    if (!known) {
      if (absl::Status s = Read(stop); !s.ok()) return s;
    }
    Json missing, whole;
    std::optional<Json> record;
    {
      const std::lock_guard lock(mutex_);
      missing = Missing(what, Now());
      record = record_;
      if (what == What::kAll) dirty_ = false;
      if (missing.empty()) {
        record_.reset();
        return absl::OkStatus();
      }
      whole = {{"metadata", {{"resourceVersion", version_}}}, {"status", Replacing(there_, missing)}};
    }
    if (!options_.leads()) return absl::AbortedError("this control plane leads no more");
    const absl::StatusOr<Json> reply = client_->Patch(statuses_, options_.name, {.body = whole}, Once(stop));
    const std::lock_guard lock(mutex_);
    if (reply.ok()) {
      version_ = TextAt(*reply, {"metadata", "resourceVersion"});
      there_.update(missing);
      if (record_ == record) record_.reset();
      return absl::OkStatus();
    }
    dirty_ = true;
    version_.clear();  // also when the reply was lost: it may have been written
    if (absl::IsNotFound(reply.status())) return absl::AbortedError("the World is gone");
    if (!absl::IsAborted(reply.status())) return reply.status();
  }
}

absl::Status StatusStore::Read(const std::stop_token& stop) {
  const absl::StatusOr<Json> world = client_->Get(worlds_, options_.name, Once(stop));
  if (absl::IsNotFound(world.status())) return absl::AbortedError("the World is gone");
  if (!world.ok()) return absl::UnavailableError(world.status().message());
  if (TextAt(*world, {"metadata", "uid"}) != options_.uid) return absl::AbortedError("the World is another one");
  const Json* const status = Find(*world, {"status"});
  const std::lock_guard lock(mutex_);
  there_ = status != nullptr && status->is_object() ? *status : Json::object();
  if (IntegerAt(there_, {kEpoch}).value_or(0) > options_.epoch) {
    return absl::AbortedError("another control plane has the world");
  }
  version_ = TextAt(*world, {"metadata", "resourceVersion"});
  return absl::OkStatus();
}

}  // namespace aureole::kubernetes
