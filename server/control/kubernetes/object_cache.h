// The objects of a list and a watch, and what changed since they were last asked for. No clock, no thread.
#pragma once

#include <list>
#include <map>
#include <memory>
#include <string>
#include <unordered_map>
#include <vector>

#include <absl/status/status.h>

#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/json.h"

namespace aureole::kubernetes {

using Object = std::shared_ptr<const Json>;
using Objects = std::map<std::string, Object>;  // by "namespace/name", or "name" of those without a namespace

struct Change {
  enum class Kind : uint8_t { kAdded, kModified, kDeleted };
  Kind kind = Kind::kAdded;
  Object object;  // of a deleted one: as last seen
};

// An object is one uid: a name that is used again is a deleted object and an added one. All changes of an object since
// the last Take are one Change; so what waits to be taken is bounded by the objects, however long nobody takes.
class ObjectCache {
 public:
  // A new list: what is in it no more is deleted. DataLoss, and nothing has changed, when an item has no name or uid.
  absl::Status Replace(std::vector<Json> items);
  // A watch event. DataLoss as above. Bookmarks change nothing.
  absl::Status Apply(WatchEvent event);

  // Ordered by each object's last change.
  std::vector<Change> Take();
  bool has_changes() const { return !changes_.empty(); }
  const Objects& objects() const { return objects_; }

 private:
  void Put(const std::string& key, Json object);
  void Remove(const std::string& key, Object last);
  void Note(Change::Kind kind, Object object);

  Objects objects_;
  std::list<Change> changes_;
  std::unordered_map<std::string, std::list<Change>::iterator> change_of_;  // by uid
};

}  // namespace aureole::kubernetes
