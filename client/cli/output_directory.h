// Where a command writes its results.
#pragma once

#include <filesystem>
#include <string>

#include <absl/status/status.h>

namespace aureole {

// Makes the directory where there is none. InvalidArgument, naming --out, when nothing can be written into it.
absl::Status MakeOutputDirectory(const std::filesystem::path& directory);

// Replaces the file. Internal when it cannot be written whole.
absl::Status WriteText(const std::filesystem::path& file, const std::string& text);

}  // namespace aureole
