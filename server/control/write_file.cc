#include "server/control/write_file.h"

#include <fcntl.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <cstring>

#include <absl/strings/str_cat.h>

namespace aureole {

absl::Status WriteFile(const std::filesystem::path& path, const std::string& text, mode_t mode) {
  const std::string next = path.string() + ".new";
  unlink(next.c_str());
  const int file = open(next.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, mode);
  const bool written =
      file >= 0 && write(file, text.data(), text.size()) == static_cast<ssize_t>(text.size()) && fsync(file) == 0;
  const bool placed = written && rename(next.c_str(), path.c_str()) == 0;
  const int error = errno;
  if (file >= 0) close(file);
  if (placed) return absl::OkStatus();
  return absl::PermissionDeniedError(absl::StrCat(path.string(), ": cannot be written: ", std::strerror(error)));
}

}  // namespace aureole
