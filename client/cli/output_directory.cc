#include "client/cli/output_directory.h"

#include <unistd.h>

#include <fstream>

#include <absl/strings/str_cat.h>

namespace aureole {

absl::Status MakeOutputDirectory(const std::filesystem::path& directory) {
  std::error_code error;
  std::filesystem::create_directories(directory, error);
  if (!error && access(directory.c_str(), W_OK) == 0) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("--out: cannot write to ", directory.string(), error ? ": " + error.message() : ""));
}

absl::Status WriteText(const std::filesystem::path& file, const std::string& text) {
  std::ofstream out(file, std::ios::binary | std::ios::trunc);
  out << text;
  out.close();
  return out ? absl::OkStatus() : absl::InternalError(absl::StrCat("cannot write ", file.string()));
}

}  // namespace aureole
