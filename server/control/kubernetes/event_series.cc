#include "server/control/kubernetes/event_series.h"

#include <algorithm>
#include <utility>

#include <absl/strings/str_format.h>

namespace aureole::kubernetes {
namespace {

constexpr size_t kMostMessage = 1000;

std::string SecondTime(absl::Time time) { return absl::FormatTime("%Y-%m-%dT%H:%M:%SZ", time, absl::UTCTimeZone()); }

}  // namespace

ObjectReference ReferenceTo(const Json& object, const std::string& api_version, const std::string& kind) {
  return {api_version, kind, TextAt(object, {"metadata", "namespace"}), TextAt(object, {"metadata", "name"}),
          TextAt(object, {"metadata", "uid"})};
}

EventSeries::EventSeries(std::string component, std::string instance)
    : component_(std::move(component)), instance_(std::move(instance)) {}

bool EventSeries::Add(Event event, absl::Time now) {
  if (event.message.size() > kMostMessage) event.message.resize(kMostMessage);
  auto it = table_.find(event);
  if (it != table_.end() && !it->second.waits && !it->second.out && now - it->second.last > kMemory) {
    table_.erase(it);
    it = table_.end();
  }
  if (it == table_.end()) {
    if (table_.size() >= kMost && !MakeRoom()) return false;
    it = table_.emplace(std::move(event), Series()).first;
    it->second.first = now;
  }
  Series& series = it->second;
  ++series.count;
  series.last = now;
  series.tries = 0;
  Queue(it);
  return true;
}

std::optional<EventWrite> EventSeries::Next(absl::Time now) {
  if (waiting_.empty()) return std::nullopt;
  const Table::iterator it = waiting_.front();
  waiting_.pop_front();
  const Event& event = it->first;
  Series& series = it->second;
  series.waits = false;
  series.out = true;
  ++series.tries;
  EventWrite write;
  write.event = event;
  write.space = event.about.space.empty() ? "default" : event.about.space;
  write.name = series.name;
  write.count = series.count;
  if (!series.name.empty()) {
    write.object = {{"count", series.count}, {"lastTimestamp", SecondTime(series.last)}};
    return write;
  }
  stamp_ = std::max(stamp_ + 1, absl::ToUnixNanos(now));
  const std::string name = absl::StrFormat("%.200s.%x", event.about.name, stamp_);
  write.object = {{"apiVersion", "v1"},
                  {"kind", "Event"},
                  {"metadata", {{"name", name}, {"namespace", write.space}}},
                  {"involvedObject",
                   {{"apiVersion", event.about.api_version},
                    {"kind", event.about.kind},
                    {"namespace", event.about.space},
                    {"name", event.about.name},
                    {"uid", event.about.uid}}},
                  {"type", event.warning ? "Warning" : "Normal"},
                  {"reason", event.reason},
                  {"message", event.message},
                  {"count", series.count},
                  {"firstTimestamp", SecondTime(series.first)},
                  {"lastTimestamp", SecondTime(series.last)},
                  {"source", {{"component", component_}}},
                  {"reportingComponent", component_},
                  {"reportingInstance", instance_}};
  return write;
}

void EventSeries::Written(const EventWrite& write, const std::string& name) {
  Series& series = table_.at(write.event);
  series.out = false;
  series.name = name;
  series.written = write.count;
  series.tries = 0;
  if (series.count > series.written) Queue(table_.find(write.event));
}

void EventSeries::Gone(const EventWrite& write) {
  const auto it = table_.find(write.event);
  it->second.out = false;
  it->second.name.clear();
  Queue(it);
}

bool EventSeries::Failed(const EventWrite& write) {
  const auto it = table_.find(write.event);
  it->second.out = false;
  if (it->second.tries >= kMostTries) return false;
  Queue(it);
  return true;
}

void EventSeries::Queue(Table::iterator it) {
  Series& series = it->second;
  if (series.waits || series.out) return;  // what is out is queued again when it comes back
  series.waits = true;
  waiting_.push_back(it);
}

// Forgets what has not repeated for the longest time.
bool EventSeries::MakeRoom() {
  auto oldest = table_.end();
  for (auto it = table_.begin(); it != table_.end(); ++it) {
    if (it->second.waits || it->second.out) continue;
    if (oldest == table_.end() || it->second.last < oldest->second.last) oldest = it;
  }
  if (oldest == table_.end()) return false;
  table_.erase(oldest);
  return true;
}

}  // namespace aureole::kubernetes
