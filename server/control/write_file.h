// Files that others read while they are written.
#pragma once

#include <sys/types.h>

#include <filesystem>
#include <string>

#include <absl/status/status.h>

namespace aureole {

// Whole, or not at all. PermissionDenied, with the reason, when it cannot be.
absl::Status WriteFile(const std::filesystem::path& path, const std::string& text, mode_t mode);

}  // namespace aureole
