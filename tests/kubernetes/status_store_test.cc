// The record is durable when Save returns, what people see follows within a second, and nobody overwrites who has the
// world after us. The faults, by kAllFaults: of the write: a conflict by another writer, 429 with Retry-After, 500,
// 503, a reply that is lost, cut or late, an expired token; of the read: 503, a reply that is cut.
#include "server/control/kubernetes/status_store.h"

#include <gtest/gtest.h>

#include <atomic>
#include <memory>
#include <mutex>
#include <thread>

#include <absl/strings/match.h>

#include "tests/kubernetes/await.h"
#include "tests/kubernetes/fake_api_server.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using Kind = Fault::Kind;

constexpr char kWorld[] = "/apis/aureole.dev/v1alpha1/namespaces/test/worlds/w";

v1::WorldRecord Record(uint64_t incarnation) {
  v1::WorldRecord record;
  record.set_world_hash(0xfedcba9876543210);
  record.add_regions()->set_incarnation(incarnation);
  return record;
}

WorldStatus Status(int64_t tick, bool ready = true) {
  WorldStatus status;
  status.generation = 1;
  status.fields = {{"tick", tick}};
  status.conditions = {{"Ready", ready, ready ? "Running" : "Recovering", ""}};
  return status;
}

class StatusStoreTest : public testing::Test {
 protected:
  StatusStoreTest() {
    uid_ = TextAt(server_.Put(kWorld, {{"spec", {{"a", 1}}}}), {"metadata", "uid"});
    Open(1);
  }
  void Open(int64_t epoch, milliseconds interval = milliseconds(1)) {
    store_.reset();
    StatusStore::Options options;
    options.space = "test";
    options.name = "w";
    options.uid = uid_;
    options.epoch = epoch;
    options.leads = [this] { return leads_.load(); };
    options.interval = interval;
    options.first_pause = milliseconds(5);
    options.longest_pause = milliseconds(50);
    options.first_refusal = milliseconds(200);
    options.longest_refusal = milliseconds(400);
    options.refused = [this](const std::string& why) {
      const std::lock_guard lock(mutex_);
      refusals_.push_back(why);
    };
    store_ = std::make_unique<StatusStore>(&client_, options);
  }
  Json There() { return (*server_.At(kWorld))["status"]; }
  std::vector<std::string> Refusals() {
    const std::lock_guard lock(mutex_);
    return refusals_;
  }
  // What the schema does with a status that has this text.
  static Fault Refusal(const std::string& text, int times) {
    return {.kind = Kind::kStatus,
            .method = "PATCH",
            .times = times,
            .status = 422,
            .body = text,
            .message = "World \"w\" is invalid: status.tick: Invalid value: \"string\""};
  }

  FakeApiServer server_;
  ApiClient client_{server_.Access()};
  std::string uid_;
  std::atomic<bool> leads_ = true;
  std::mutex mutex_;
  std::vector<std::string> refusals_;
  std::unique_ptr<StatusStore> store_;
};

TEST_F(StatusStoreTest, RecordIsThereForTheNext) {
  const auto nothing = store_->Load();
  ASSERT_TRUE(nothing.ok()) << nothing.status();
  EXPECT_FALSE(nothing->has_value());
  v1::WorldRecord record = Record(3);
  record.set_start_unix_us(5);
  ASSERT_TRUE(store_->Save(record).ok());
  record.clear_start_unix_us();
  record.add_regions()->set_endpoint("10.0.0.1:7000");
  ASSERT_TRUE(store_->Save(record).ok());
  Open(2);
  const auto found = store_->Load();
  ASSERT_TRUE(found.ok()) << found.status();
  EXPECT_EQ((*found)->SerializeAsString(), record.SerializeAsString());
  ASSERT_TRUE(store_->Forget().ok());
  EXPECT_FALSE(store_->Load()->has_value());
  EXPECT_EQ((*server_.At(kWorld))["spec"], (Json{{"a", 1}}));
}

TEST_F(StatusStoreTest, FieldsAreWrittenOnlyWhenTheyChange) {
  store_->Publish(Status(5));
  ASSERT_TRUE(store_->Flush(seconds(20)));
  EXPECT_EQ(There()["tick"], 5);
  EXPECT_EQ(There()["observedGeneration"], 1);
  EXPECT_EQ(There()["controlEpoch"], 1);
  const int writes = server_.Count("PATCH");
  for (int i = 0; i < 5; ++i) store_->Publish(Status(5));
  ASSERT_TRUE(store_->Flush(seconds(20)));
  EXPECT_EQ(server_.Count("PATCH"), writes);
  store_->Publish(Status(6));
  ASSERT_TRUE(store_->Flush(seconds(20)));
  EXPECT_EQ(server_.Count("PATCH"), writes + 1);
  EXPECT_EQ(There()["tick"], 6);
}

TEST_F(StatusStoreTest, ManyChangesAreOneWriteAndTheRecordDoesNotWaitForThem) {
  Open(1, seconds(30));
  store_->Publish(Status(1));
  ASSERT_TRUE(store_->Flush(seconds(20)));
  const int writes = server_.Count("PATCH");
  for (int i = 2; i < 100; ++i) store_->Publish(Status(i));
  EXPECT_EQ(server_.Count("PATCH"), writes);
  ASSERT_TRUE(store_->Save(Record(1)).ok());
  EXPECT_EQ(server_.Count("PATCH"), writes + 1);
  EXPECT_EQ(There()["tick"], 99) << "it goes along";
}

TEST_F(StatusStoreTest, ObjectsAreReplacedWhole) {
  WorldStatus status = Status(1);
  status.fields["hash"] = {{"tick", 1}, {"hash", "a"}};
  store_->Publish(status);
  ASSERT_TRUE(store_->Flush(seconds(20)));
  status.fields["hash"] = {{"tick", 2}};
  status.fields["tick"] = nullptr;
  store_->Publish(status);
  ASSERT_TRUE(store_->Flush(seconds(20)));
  EXPECT_EQ(There()["hash"], (Json{{"tick", 2}}));
  EXPECT_FALSE(There().contains("tick"));
}

TEST_F(StatusStoreTest, WhoComesLaterHasTheWorld) {
  ASSERT_TRUE(store_->Save(Record(1)).ok());
  StatusStore::Options options;
  options.space = "test";
  options.name = "w";
  options.uid = uid_;
  options.epoch = 2;
  StatusStore next(&client_, options);
  ASSERT_TRUE(next.Load().ok());
  ASSERT_TRUE(next.Save(Record(2)).ok());
  EXPECT_TRUE(absl::IsAborted(store_->Save(Record(9))));
  store_->Publish(Status(9));
  EXPECT_TRUE(absl::IsAborted(store_->Save(Record(9))));
  EXPECT_EQ(There()["record"]["regions"][0]["incarnation"], "2");
  EXPECT_FALSE(There().contains("tick"));
  Open(1);
  EXPECT_TRUE(absl::IsAborted(store_->Load().status()));
}

TEST_F(StatusStoreTest, WhoLeadsNoMoreWritesNothing) {
  leads_ = false;
  EXPECT_TRUE(absl::IsAborted(store_->Save(Record(1))));
  EXPECT_EQ(server_.Count("PATCH"), 0);
}

TEST_F(StatusStoreTest, WorldThatIsGoneOrAnotherIsSaid) {
  ASSERT_TRUE(store_->Save(Record(1)).ok());
  server_.Remove(kWorld);
  EXPECT_TRUE(absl::IsAborted(store_->Save(Record(2))));
  server_.Put(kWorld, Json::object());
  Open(1);
  EXPECT_TRUE(absl::IsAborted(store_->Save(Record(2))));
  EXPECT_FALSE(server_.At(kWorld)->contains("status"));
}

TEST_F(StatusStoreTest, UnreadableRecordIsNotTakenForNone) {
  server_.Merge(kWorld, {{"status", {{"record", {{"regions", "x"}}}}}});
  EXPECT_TRUE(absl::IsDataLoss(store_->Load().status()));
  server_.Merge(kWorld, {{"status", {{"record", {{"regions", nullptr}, {"later", 1}}}}}});
  EXPECT_TRUE(store_->Load().ok()) << store_->Load().status();
}

TEST_F(StatusStoreTest, SaveThatWaitsEndsWithClose) {
  server_.Inject({.kind = Kind::kStatus, .method = "PATCH", .times = -1, .status = 503});
  std::thread closer([this] {
    EXPECT_TRUE(Await([this] { return server_.Count("PATCH") >= 3; }));
    store_->Close();
  });
  EXPECT_TRUE(absl::IsCancelled(store_->Save(Record(1))));
  closer.join();
}

TEST_F(StatusStoreTest, RefusedFieldsAreToldOfAndDoNotHoldUpTheRecord) {
  server_.Inject(Refusal("\"tick\":7", -1));
  store_->Publish(Status(7));
  ASSERT_TRUE(store_->Save(Record(1)).ok());
  ASSERT_TRUE(store_->Save(Record(2)).ok());
  EXPECT_EQ(There()["record"]["regions"][0]["incarnation"], "2");
  EXPECT_EQ(There()["controlEpoch"], 1);
  EXPECT_FALSE(There().contains("tick"));
  ASSERT_EQ(Refusals().size(), 1u) << "it is the same one";
  EXPECT_TRUE(absl::StrContains(Refusals()[0], "422 Invalid: World \"w\" is invalid: status.tick: Invalid value"));
  EXPECT_GE(client_.stats().refused, 1);
  store_->Publish(Status(8));
  EXPECT_TRUE(Await([&] { return IntegerAt(There(), {"tick"}) == 8; })) << "those that are right are written";
}

TEST_F(StatusStoreTest, RefusedStatusIsTriedAgainMoreAndMoreSeldom) {
  server_.Inject(Refusal("", -1));
  const auto end = std::chrono::steady_clock::now() + seconds(2);
  for (int64_t tick = 1; std::chrono::steady_clock::now() < end; ++tick) {
    store_->Publish(Status(tick));
    std::this_thread::sleep_for(milliseconds(2));
  }
  EXPECT_GE(server_.Count("PATCH"), 4) << "it may be right by now";
  EXPECT_LE(server_.Count("PATCH"), 16) << "with each a try with the epoch alone";
  EXPECT_EQ(Refusals().size(), 1u);
}

TEST_F(StatusStoreTest, RecordThatIsRefusedIsAnErrorAndNotAWait) {
  server_.Inject(Refusal("record", -1));
  const absl::Status s = store_->Save(Record(1));
  EXPECT_TRUE(absl::IsInvalidArgument(s)) << s;
  EXPECT_TRUE(absl::StrContains(s.message(), "status.tick: Invalid value"));
  EXPECT_EQ(Refusals().size(), 1u);
  store_->Publish(Status(7));
  EXPECT_TRUE(Await([&] { return IntegerAt(There(), {"tick"}) == 7; }));
}

TEST_F(StatusStoreTest, ForbiddenStatusIsToldOfAndWaitedFor) {
  server_.Inject({.kind = Kind::kStatus, .method = "PATCH", .times = 3, .status = 403});
  ASSERT_TRUE(store_->Save(Record(1)).ok());
  EXPECT_EQ(Refusals().size(), 1u);
}

struct FaultCase {
  const char* name;
  Fault fault;
};
void PrintTo(const FaultCase& tested, std::ostream* out) { *out << tested.name; }

class StatusStoreFault : public StatusStoreTest, public testing::WithParamInterface<FaultCase> {};

TEST_P(StatusStoreFault, RecordIsDurableAndFieldsFollow) {
  ASSERT_TRUE(store_->Save(Record(1)).ok());
  server_.Inject(GetParam().fault);
  server_.Put(kWorld, {{"spec", {{"a", 2}}}, {"status", There()}});  // somebody else: a conflict, then a read
  store_->Publish(Status(7));
  ASSERT_TRUE(store_->Save(Record(2)).ok());
  EXPECT_EQ(There()["record"]["regions"][0]["incarnation"], "2");
  ASSERT_TRUE(store_->Flush(seconds(20)));
  EXPECT_EQ(There()["tick"], 7);
  EXPECT_EQ((*server_.At(kWorld))["spec"]["a"], 2);
  EXPECT_EQ(server_.faults_left(), 0u) << "the fault was not met";
}

Fault OfWrite(Fault fault) {
  fault.method = "PATCH";
  return fault;
}

INSTANTIATE_TEST_SUITE_P(
    kAllFaults, StatusStoreFault,
    testing::Values(FaultCase{"Conflict", OfWrite({.times = 3, .status = 409})},
                    FaultCase{"Status429WithRetryAfter", OfWrite({.status = 429, .retry_after = 1})},
                    FaultCase{"Status500", OfWrite({.times = 3, .status = 500})},
                    FaultCase{"Status503", OfWrite({.times = 3, .status = 503})},
                    FaultCase{"ReplyLost", OfWrite({.kind = Kind::kLostReply, .times = 2})},
                    FaultCase{"ReplyCut", OfWrite({.kind = Kind::kBrokenJson, .times = 2})},
                    FaultCase{"ReplyLate", OfWrite({.kind = Kind::kSlow, .delay = milliseconds(300)})},
                    FaultCase{"TokenExpired", OfWrite({.times = 2, .status = 401})},
                    FaultCase{"ReadStatus503", {.times = 3, .status = 503}},
                    FaultCase{"ReadReplyCut", {.kind = Kind::kBrokenJson, .times = 2}}),
    [](const auto& tested) { return std::string(tested.param.name); });

}  // namespace
}  // namespace aureole::kubernetes
