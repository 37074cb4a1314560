#include "server/control/kubernetes/object_cache.h"

#include <set>
#include <utility>

#include <absl/strings/str_cat.h>

namespace aureole::kubernetes {
namespace {

std::string UidOf(const Json& object) { return TextAt(object, {"metadata", "uid"}); }
std::string VersionOf(const Json& object) { return TextAt(object, {"metadata", "resourceVersion"}); }

std::string KeyOf(const Json& object) {
  const std::string space = TextAt(object, {"metadata", "namespace"}), name = TextAt(object, {"metadata", "name"});
  return space.empty() ? name : absl::StrCat(space, "/", name);
}

absl::Status CheckIdentity(const Json& object) {
  for (const char* field : {"name", "uid"}) {
    if (TextAt(object, {"metadata", field}).empty()) {
      return absl::DataLossError(absl::StrCat("an object without metadata.", field));
    }
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status ObjectCache::Replace(std::vector<Json> items) {
  for (const Json& item : items) {
    if (absl::Status s = CheckIdentity(item); !s.ok()) return s;
  }
  std::set<std::string> listed;
  for (const Json& item : items) listed.insert(KeyOf(item));
  for (auto it = objects_.begin(); it != objects_.end();) {
    const auto [key, object] = *it++;
    if (!listed.contains(key)) Remove(key, object);
  }
  for (Json& item : items) {
    const std::string key = KeyOf(item);
    Put(key, std::move(item));
  }
  return absl::OkStatus();
}

absl::Status ObjectCache::Apply(WatchEvent event) {
  if (event.kind == WatchEvent::Kind::kBookmark) return absl::OkStatus();
  if (absl::Status s = CheckIdentity(event.object); !s.ok()) return s;
  const std::string key = KeyOf(event.object);
  if (event.kind != WatchEvent::Kind::kDeleted) {
    Put(key, std::move(event.object));
    return absl::OkStatus();
  }
  const auto found = objects_.find(key);
  // Another uid: the name has a new owner already, and the deletion was reported then.
  if (found == objects_.end() || UidOf(*found->second) != UidOf(event.object)) return absl::OkStatus();
  Remove(key, std::make_shared<const Json>(std::move(event.object)));
  return absl::OkStatus();
}

std::vector<Change> ObjectCache::Take() {
  std::vector<Change> out(std::make_move_iterator(changes_.begin()), std::make_move_iterator(changes_.end()));
  changes_.clear();
  change_of_.clear();
  return out;
}

void ObjectCache::Put(const std::string& key, Json object) {
  const auto found = objects_.find(key);
  bool known = found != objects_.end();
  if (known && UidOf(*found->second) != UidOf(object)) {
    Remove(key, found->second);
    known = false;
  }
  if (known && VersionOf(*found->second) == VersionOf(object)) return;
  Object shared = std::make_shared<const Json>(std::move(object));
  objects_[key] = shared;
  Note(known ? Change::Kind::kModified : Change::Kind::kAdded, std::move(shared));
}

void ObjectCache::Remove(const std::string& key, Object last) {
  objects_.erase(key);
  Note(Change::Kind::kDeleted, std::move(last));
}

void ObjectCache::Note(Change::Kind kind, Object object) {
  using Kind = Change::Kind;
  const std::string uid = UidOf(*object);
  if (const auto found = change_of_.find(uid); found != change_of_.end()) {
    const Kind before = found->second->kind;
    changes_.erase(found->second);
    change_of_.erase(found);
    if (before == Kind::kAdded && kind == Kind::kDeleted) return;  // come and gone unseen
    if (before == Kind::kAdded) kind = Kind::kAdded;
    // An older server's list can bring it back.
    if (before == Kind::kDeleted && kind == Kind::kAdded) kind = Kind::kModified;
  }
  changes_.push_back({kind, std::move(object)});
  change_of_[uid] = std::prev(changes_.end());
}

}  // namespace aureole::kubernetes
