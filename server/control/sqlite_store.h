// A world's record, and what has happened to it, in a file of SQLite's.
#pragma once

#include <filesystem>
#include <memory>
#include <vector>

#include "server/control/run_event.h"
#include "server/control/world_store.h"

struct sqlite3;

namespace aureole {

class SqliteStore final : public WorldStore {
 public:
  // Makes the file, and its directory, when missing. FailedPrecondition: another control plane has it open.
  // Unavailable: it cannot be opened. DataLoss: it is not such a file, or is damaged.
  static absl::StatusOr<std::unique_ptr<SqliteStore>> Open(const std::filesystem::path& path);
  ~SqliteStore() override;
  SqliteStore(const SqliteStore&) = delete;
  SqliteStore& operator=(const SqliteStore&) = delete;

  absl::StatusOr<std::optional<v1::WorldRecord>> Load() override;
  absl::Status Save(const v1::WorldRecord& record) override;

  // How many control planes have opened the file, this one included: each one's epoch is higher than those before.
  uint64_t epoch() const { return epoch_; }
  // Of ascending sequence. Keeps the newest EventLog::kMostEvents.
  absl::Status Append(const RunEvent& event);
  // The newest `most`, oldest first.
  absl::StatusOr<std::vector<RunEvent>> Events(int most);

 private:
  class Statement;
  explicit SqliteStore(sqlite3* db) : db_(db) {}
  absl::Status Prepare();
  absl::Status Execute(const char* sql);

  sqlite3* const db_;
  uint64_t epoch_ = 0;
};

}  // namespace aureole
