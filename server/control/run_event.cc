#include "server/control/run_event.h"

#include <absl/strings/ascii.h>
#include <absl/strings/str_cat.h>

namespace aureole {

bool IsWarning(EventKind kind) {
  switch (kind) {
    case v1::ControlEvent::REGION_ENDED:
    case v1::ControlEvent::REGION_REPLACED:
    case v1::ControlEvent::LAYOUT_REFUSED:
    case v1::ControlEvent::STORAGE_FAILED:
    case v1::ControlEvent::COPY_LOST:
    case v1::ControlEvent::COPY_FETCHED:
    case v1::ControlEvent::REGION_LATE:
    case v1::ControlEvent::REGION_STAYS:
      return true;
    default:
      return false;
  }
}

std::string TextOf(const RunEvent& event) {
  return event.region == kNoRegion ? event.what : absl::StrCat("region ", event.region, ": ", event.what);
}

std::string NameOf(EventKind kind) {
  std::string out = absl::AsciiStrToLower(v1::ControlEvent::Kind_Name(kind));
  for (size_t i = 0; i < out.size(); ++i) {
    if (i == 0 || out[i - 1] == '_') out[i] = absl::ascii_toupper(static_cast<unsigned char>(out[i]));
  }
  std::erase(out, '_');
  return out;
}

}  // namespace aureole
