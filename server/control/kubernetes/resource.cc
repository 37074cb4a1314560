#include "server/control/kubernetes/resource.h"

#include <absl/strings/ascii.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>

namespace aureole::kubernetes {

Resource Resource::Sub(const std::string& name) const {
  Resource out = *this;
  out.subresource = name;
  return out;
}

std::string Resource::ApiVersion() const { return group.empty() ? version : absl::StrCat(group, "/", version); }

std::string Resource::CollectionPath() const {
  return absl::StrCat(group.empty() ? "/api" : "/apis/" + UrlEncoded(group), "/", UrlEncoded(version),
                      space.empty() ? "" : "/namespaces/" + UrlEncoded(space), "/", UrlEncoded(plural));
}

absl::StatusOr<std::string> Resource::ObjectPath(const std::string& name) const {
  if (name.empty() || name == "." || name == "..") {
    return absl::InvalidArgumentError(absl::StrCat(plural, ": metadata.name: '", name, "' names no object"));
  }
  return absl::StrCat(CollectionPath(), "/", UrlEncoded(name),
                      subresource.empty() ? "" : "/" + UrlEncoded(subresource));
}

std::string UrlEncoded(const std::string& text) {
  std::string out;
  for (const char c : text) {
    if (absl::ascii_isalnum(static_cast<unsigned char>(c)) || c == '-' || c == '.' || c == '_' || c == '~') {
      out += c;
    } else {
      out += absl::StrFormat("%%%02X", static_cast<unsigned char>(c));
    }
  }
  return out;
}

}  // namespace aureole::kubernetes
