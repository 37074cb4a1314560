// Which v1 Events to write so that repeats are counted in one. No clock, no thread.
#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <optional>
#include <string>
#include <tuple>

#include <absl/time/time.h>

#include "server/control/kubernetes/json.h"

namespace aureole::kubernetes {

// The object that an event is about.
struct ObjectReference {
  std::string api_version, kind, space, name, uid;
  friend auto operator<=>(const ObjectReference&, const ObjectReference&) = default;
};

// `object` as the API gave it; items of a list do not say their apiVersion and kind.
ObjectReference ReferenceTo(const Json& object, const std::string& api_version, const std::string& kind);

struct Event {
  ObjectReference about;
  bool warning = false;
  std::string reason;   // one word in CamelCase: "RegionLost"
  std::string message;  // for people; what is beyond 1000 bytes is cut off
  friend auto operator<=>(const Event&, const Event&) = default;
};

// A request: create `object` when `name` is empty, else merge `object` into the event of that name.
struct EventWrite {  // NOLINT(bugprone-exception-escape): clang-tidy doubts the move of nlohmann::json
  Event event;
  std::string space, name;
  Json object;
  int64_t count = 0;
};

// An event is equal to another, and counted with it, when all of its fields are, for as long as it repeats within
// kMemory.
class EventSeries {
 public:
  static constexpr size_t kMost = 512;  // series at a time; more than that unwritten are refused
  static constexpr absl::Duration kMemory = absl::Minutes(10);
  static constexpr int kMostTries = 3;

  // `component` and `instance` say who records: "aureole-control", and the pod's name.
  EventSeries(std::string component, std::string instance);

  // False: there are too many, and it is dropped.
  bool Add(Event event, absl::Time now);
  // The next write; it is out until one of the three below is called with it.
  std::optional<EventWrite> Next(absl::Time now);
  void Written(const EventWrite& write, const std::string& name);
  // The event of that name has been removed (they live for an hour): it is created anew.
  void Gone(const EventWrite& write);
  // It is tried again, at most kMostTries times in all; false: given up. The count is kept for a later repeat.
  bool Failed(const EventWrite& write);
  // Series that have still to be written.
  size_t waiting() const { return waiting_.size(); }

 private:
  struct Series {
    std::string name;  // empty: not created yet
    int64_t count = 0, written = 0;
    absl::Time first, last;
    bool waits = false, out = false;
    int tries = 0;
  };
  using Table = std::map<Event, Series>;

  void Queue(Table::iterator it);
  bool MakeRoom();

  const std::string component_, instance_;
  Table table_;
  std::deque<Table::iterator> waiting_;
  int64_t stamp_ = 0;  // of the last name, so that no two are equal
};

}  // namespace aureole::kubernetes
