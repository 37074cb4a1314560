#include "server/control/sqlite_store.h"

#include <gtest/gtest.h>
#include <sqlite3.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>

namespace aureole {
namespace {

namespace fs = std::filesystem;

class Store : public testing::Test {
 protected:
  Store() {
    std::string name = (fs::temp_directory_path() / "store-test-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
  }
  ~Store() override { fs::remove_all(directory_); }

  std::unique_ptr<SqliteStore> Open() {
    absl::StatusOr<std::unique_ptr<SqliteStore>> store = SqliteStore::Open(path());
    EXPECT_TRUE(store.ok()) << store.status();
    return store.ok() ? *std::move(store) : nullptr;
  }
  fs::path path() const { return directory_ / "new" / "control.db"; }

  fs::path directory_;
};

v1::WorldRecord RecordOf(int64_t start) {
  v1::WorldRecord record;
  record.set_world_hash(0xfeed);
  record.set_start_unix_us(start);
  record.add_regions()->set_incarnation(3);
  return record;
}

TEST_F(Store, KeepsTheNewestRecord) {
  {
    const auto store = Open();
    EXPECT_EQ(*store->Load(), std::nullopt);
    ASSERT_TRUE(store->Save(RecordOf(1)).ok());
    ASSERT_TRUE(store->Save(RecordOf(2)).ok());
  }
  const auto store = Open();
  const auto record = store->Load();
  ASSERT_TRUE(record.ok() && record->has_value());
  EXPECT_EQ((*record)->SerializeAsString(), RecordOf(2).SerializeAsString());
}

TEST_F(Store, EpochGrowsWithEveryOpening) {
  EXPECT_EQ(Open()->epoch(), 1u);
  EXPECT_EQ(Open()->epoch(), 2u);
}

TEST_F(Store, IsOfOneControlPlaneAtATime) {
  const auto first = Open();
  const auto second = SqliteStore::Open(path());
  EXPECT_EQ(second.status().code(), absl::StatusCode::kFailedPrecondition) << second.status();
  EXPECT_NE(second.status().message().find("another control plane has it open"), std::string::npos);
  EXPECT_TRUE(first->Save(RecordOf(5)).ok());
}

TEST_F(Store, EventsComeBackInOrder) {
  const auto store = Open();
  for (int i = 0; i < 5; ++i) {
    const std::chrono::system_clock::time_point time{std::chrono::microseconds(1000 + i)};
    ASSERT_TRUE(
        store->Append({time, v1::ControlEvent::COPY_LOST, i - 1, "what " + std::to_string(i), 10u * (i + 1)}).ok());
  }
  const auto events = store->Events(3);
  ASSERT_TRUE(events.ok());
  ASSERT_EQ(events->size(), 3u);
  EXPECT_EQ(events->front().what, "what 2");
  EXPECT_EQ(events->back().region, 3);
  EXPECT_EQ(events->back().sequence, 50u);
  EXPECT_EQ(events->back().kind, v1::ControlEvent::COPY_LOST);
  EXPECT_EQ(events->back().time.time_since_epoch(), std::chrono::microseconds(1004));
}

TEST_F(Store, EventsOfAFileFromBeforeTheyHadKindsAreRead) {
  fs::create_directories(path().parent_path());
  sqlite3* db = nullptr;
  ASSERT_EQ(sqlite3_open(path().c_str(), &db), SQLITE_OK);
  ASSERT_EQ(sqlite3_exec(db,
                         "CREATE TABLE events(id INTEGER PRIMARY KEY, time_us INTEGER NOT NULL, region INTEGER NOT"
                         " NULL, what TEXT NOT NULL); INSERT INTO events(time_us, region, what) VALUES (7, 1, 'old')",
                         nullptr, nullptr, nullptr),
            SQLITE_OK);
  sqlite3_close(db);
  const auto store = Open();
  ASSERT_TRUE(store->Append({{}, v1::ControlEvent::REGION_LEFT, 2, "new", 12}).ok());
  const auto events = store->Events(3);
  ASSERT_TRUE(events.ok()) << events.status();
  ASSERT_EQ(events->size(), 2u);
  EXPECT_EQ(events->front().kind, v1::ControlEvent::UNKNOWN);
  EXPECT_EQ(events->front().what, "old");
  EXPECT_EQ(events->back().kind, v1::ControlEvent::REGION_LEFT);
}

TEST_F(Store, DamagedFileIsNotTakenForAnEmptyOne) {
  Open();
  std::ofstream(path(), std::ios::binary | std::ios::trunc) << "this is not a data base, although it is long enough";
  EXPECT_EQ(SqliteStore::Open(path()).status().code(), absl::StatusCode::kDataLoss);
  fs::create_directories(directory_ / "folder");
  EXPECT_EQ(SqliteStore::Open(directory_ / "folder").status().code(), absl::StatusCode::kUnavailable);
}

}  // namespace
}  // namespace aureole
