#include "server/control/sqlite_store.h"

#include <sqlite3.h>

#include <algorithm>
#include <string>
#include <system_error>

#include <absl/strings/str_cat.h>

#include "server/control/event_log.h"

namespace aureole {
namespace {

absl::Status ErrorOf(sqlite3* db, int code) {
  const std::string message = absl::StrCat("the store: ", sqlite3_errmsg(db));
  switch (code & 0xff) {
    case SQLITE_BUSY:
    case SQLITE_LOCKED:
      return absl::FailedPreconditionError(absl::StrCat(message, "; another control plane has it open"));
    case SQLITE_CORRUPT:
    case SQLITE_NOTADB:
      return absl::DataLossError(message);
    default:
      return absl::UnavailableError(message);
  }
}

}  // namespace

// One statement that is run once.
class SqliteStore::Statement {
 public:
  Statement(sqlite3* db, const char* sql) : db_(db) { code_ = sqlite3_prepare_v2(db, sql, -1, &statement_, nullptr); }
  ~Statement() { sqlite3_finalize(statement_); }
  Statement(const Statement&) = delete;
  Statement& operator=(const Statement&) = delete;

  void Bind(int at, int64_t value) {
    if (code_ == SQLITE_OK) code_ = sqlite3_bind_int64(statement_, at, value);
  }
  // The bytes must live as long as the statement.
  void Bind(int at, const std::string& bytes) {
    if (code_ == SQLITE_OK) {
      code_ = sqlite3_bind_blob64(statement_, at, bytes.data(), bytes.size(), SQLITE_STATIC);
    }
  }
  // True: there is a row.
  absl::StatusOr<bool> Step() {
    if (code_ == SQLITE_OK) {
      const int stepped = sqlite3_step(statement_);
      if (stepped == SQLITE_ROW || stepped == SQLITE_DONE) return stepped == SQLITE_ROW;
      code_ = stepped;
    }
    return ErrorOf(db_, code_);
  }
  int64_t Integer(int column) const { return sqlite3_column_int64(statement_, column); }
  std::string Bytes(int column) const {
    const auto* bytes = static_cast<const char*>(sqlite3_column_blob(statement_, column));
    return bytes == nullptr ? "" : std::string(bytes, static_cast<size_t>(sqlite3_column_bytes(statement_, column)));
  }

 private:
  sqlite3* const db_;
  sqlite3_stmt* statement_ = nullptr;
  int code_ = SQLITE_OK;
};

absl::StatusOr<std::unique_ptr<SqliteStore>> SqliteStore::Open(const std::filesystem::path& path) {
  std::error_code ignored;
  if (path.has_parent_path()) std::filesystem::create_directories(path.parent_path(), ignored);
  sqlite3* db = nullptr;
  const int code = sqlite3_open_v2(path.c_str(), &db, SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE, nullptr);
  std::unique_ptr<SqliteStore> out(new SqliteStore(db));
  absl::Status s = code == SQLITE_OK ? out->Prepare() : ErrorOf(db, code);
  if (!s.ok()) return absl::Status(s.code(), absl::StrCat(path.string(), ": ", std::string(s.message())));
  return out;
}

SqliteStore::~SqliteStore() { sqlite3_close(db_); }

absl::Status SqliteStore::Execute(const char* sql) {
  const int code = sqlite3_exec(db_, sql, nullptr, nullptr, nullptr);
  return code == SQLITE_OK ? absl::OkStatus() : ErrorOf(db_, code);
}

// The lock is taken with the first write and kept until the end: one control plane at a time.
absl::Status SqliteStore::Prepare() {
  if (absl::Status s = Execute("PRAGMA locking_mode = EXCLUSIVE; PRAGMA synchronous = FULL; BEGIN IMMEDIATE;"
                               "CREATE TABLE IF NOT EXISTS control(id INTEGER PRIMARY KEY CHECK(id = 1),"
                               "  epoch INTEGER NOT NULL, record BLOB);"
                               "CREATE TABLE IF NOT EXISTS events(id INTEGER PRIMARY KEY,"
                               "  time_us INTEGER NOT NULL, region INTEGER NOT NULL, what TEXT NOT NULL,"
                               "  kind INTEGER NOT NULL DEFAULT 0);"
                               "INSERT OR IGNORE INTO control VALUES (1, 0, NULL);"
                               "UPDATE control SET epoch = epoch + 1; COMMIT;");
      !s.ok()) {
    return s;
  }
  Statement kind(db_, "SELECT 1 FROM pragma_table_info('events') WHERE name = 'kind'");
  const absl::StatusOr<bool> kinds = kind.Step();
  if (!kinds.ok()) return kinds.status();
  if (!*kinds) {  // a file from before events had one
    if (absl::Status s = Execute("ALTER TABLE events ADD COLUMN kind INTEGER NOT NULL DEFAULT 0"); !s.ok()) return s;
  }
  Statement epoch(db_, "SELECT epoch FROM control");
  const absl::StatusOr<bool> row = epoch.Step();
  if (!row.ok()) return row.status();
  epoch_ = static_cast<uint64_t>(epoch.Integer(0));
  return absl::OkStatus();
}

absl::StatusOr<std::optional<v1::WorldRecord>> SqliteStore::Load() {
  Statement select(db_, "SELECT record FROM control WHERE record IS NOT NULL");
  const absl::StatusOr<bool> row = select.Step();
  if (!row.ok()) return row.status();
  if (!*row) return std::optional<v1::WorldRecord>();
  v1::WorldRecord record;
  if (!record.ParseFromString(select.Bytes(0))) return absl::DataLossError("the store: the record is damaged");
  return std::optional(std::move(record));
}

absl::Status SqliteStore::Save(const v1::WorldRecord& record) {
  const std::string bytes = record.SerializeAsString();
  Statement update(db_, "UPDATE control SET record = ?");
  update.Bind(1, bytes);
  return update.Step().status();
}

absl::Status SqliteStore::Append(const RunEvent& event) {
  const auto since = event.time.time_since_epoch();
  Statement insert(db_, "INSERT INTO events(time_us, region, what, kind, id) VALUES (?, ?, ?, ?, ?)");
  insert.Bind(1, std::chrono::duration_cast<std::chrono::microseconds>(since).count());
  insert.Bind(2, event.region);
  insert.Bind(3, event.what);
  insert.Bind(4, event.kind);
  insert.Bind(5, static_cast<int64_t>(event.sequence));
  if (absl::Status s = insert.Step().status(); !s.ok()) return s;
  Statement trim(db_, "DELETE FROM events WHERE id <= (SELECT id FROM events ORDER BY id DESC LIMIT 1 OFFSET ?)");
  trim.Bind(1, static_cast<int64_t>(EventLog::kMostEvents));
  return trim.Step().status();
}

absl::StatusOr<std::vector<RunEvent>> SqliteStore::Events(int most) {
  Statement select(db_, "SELECT time_us, kind, region, what, id FROM events ORDER BY id DESC LIMIT ?");
  select.Bind(1, most);
  std::vector<RunEvent> out;
  for (;;) {
    const absl::StatusOr<bool> row = select.Step();
    if (!row.ok()) return row.status();
    if (!*row) break;
    const auto kind = static_cast<int>(select.Integer(1));
    out.push_back({std::chrono::system_clock::time_point(std::chrono::microseconds(select.Integer(0))),
                   v1::ControlEvent::Kind_IsValid(kind) ? static_cast<EventKind>(kind) : v1::ControlEvent::UNKNOWN,
                   static_cast<RegionId>(select.Integer(2)), select.Bytes(3),
                   static_cast<uint64_t>(select.Integer(4))});
  }
  std::reverse(out.begin(), out.end());
  return out;
}

}  // namespace aureole
