// A kind of objects of the API, and the paths of its requests.
#pragma once

#include <string>

#include <absl/status/statusor.h>

namespace aureole::kubernetes {

struct Resource {
  std::string group;             // "" is the core group
  std::string version;           // "v1"
  std::string plural;            // "pods"
  std::string space;             // namespace; "" for what has none, or to list and watch that of all
  std::string subresource = "";  // "status", "scale"

  Resource Sub(const std::string& name) const;
  // "v1", "apps/v1"
  std::string ApiVersion() const;
  // "/apis/apps/v1/namespaces/aureole/statefulsets"
  std::string CollectionPath() const;
  // That of one object, with the subresource. InvalidArgument: no name, which would be the path of all objects.
  absl::StatusOr<std::string> ObjectPath(const std::string& name) const;
};

// Percent-encodes all but letters, digits and -._~
std::string UrlEncoded(const std::string& text);

}  // namespace aureole::kubernetes
