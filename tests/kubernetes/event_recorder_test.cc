// Events: repeats are counted in one, nobody waits, and a server that fails is not this side's fault.
#include <gtest/gtest.h>

#include <absl/strings/str_cat.h>

#include "server/control/kubernetes/event_recorder.h"
#include "tests/kubernetes/await.h"
#include "tests/kubernetes/fake_api_server.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using Clock = std::chrono::steady_clock;

constexpr char kEvents[] = "/api/v1/namespaces/test/events";
const ObjectReference kWorld{"aureole.example/v1", "World", "test", "w", "uid-7"};

Event Lost(int region) { return {kWorld, true, "RegionLost", absl::StrCat("region ", region, " is lost")}; }

TEST(EventSeries, RepeatsBecomeOneEventWithACount) {
  EventSeries series("aureole-control", "pod-1");
  const absl::Time now = absl::FromUnixSeconds(1136214245);
  ASSERT_TRUE(series.Add(Lost(1), now));
  ASSERT_TRUE(series.Add(Lost(1), now + absl::Seconds(1)));
  const auto first = series.Next(now + absl::Seconds(1));
  ASSERT_TRUE(first.has_value());
  EXPECT_EQ(first->name, "");
  EXPECT_EQ(first->space, "test");
  EXPECT_EQ(first->object["count"], 2);
  EXPECT_EQ(first->object["type"], "Warning");
  EXPECT_EQ(first->object["involvedObject"], (Json{{"apiVersion", "aureole.example/v1"},
                                                   {"kind", "World"},
                                                   {"namespace", "test"},
                                                   {"name", "w"},
                                                   {"uid", "uid-7"}}));
  EXPECT_EQ(first->object["firstTimestamp"], "2006-01-02T15:04:05Z");
  EXPECT_EQ(first->object["lastTimestamp"], "2006-01-02T15:04:06Z");
  EXPECT_EQ(first->object["source"]["component"], "aureole-control");
  // Repeated while the write is on its way.
  ASSERT_TRUE(series.Add(Lost(1), now + absl::Seconds(2)));
  EXPECT_EQ(series.waiting(), 0u);
  series.Written(*first, "w.1");
  const auto second = series.Next(now + absl::Seconds(2));
  EXPECT_EQ(second->name, "w.1");
  EXPECT_EQ(second->object, (Json{{"count", 3}, {"lastTimestamp", "2006-01-02T15:04:07Z"}}));
  // It has been removed meanwhile.
  series.Gone(*second);
  const auto third = series.Next(now + absl::Seconds(3));
  EXPECT_EQ(third->name, "");
  EXPECT_EQ(third->object["count"], 3);
  series.Written(*third, "w.2");
  EXPECT_EQ(series.waiting(), 0u);
  // Long after: another event.
  ASSERT_TRUE(series.Add(Lost(1), now + absl::Seconds(3) + EventSeries::kMemory));
  EXPECT_EQ(series.Next(now)->object["count"], 1);
}

TEST(EventSeries, WritesAreTriedThreeTimesAndTheCountIsKept) {
  EventSeries series("c", "i");
  ASSERT_TRUE(series.Add(Lost(1), absl::UnixEpoch()));
  for (int i = 1; i <= EventSeries::kMostTries; ++i) {
    const auto write = series.Next(absl::UnixEpoch());
    ASSERT_TRUE(write.has_value());
    EXPECT_EQ(series.Failed(*write), i < EventSeries::kMostTries);
  }
  EXPECT_FALSE(series.Next(absl::UnixEpoch()).has_value());
  ASSERT_TRUE(series.Add(Lost(1), absl::UnixEpoch()));
  EXPECT_EQ(series.Next(absl::UnixEpoch())->object["count"], 2);
}

TEST(EventSeries, NumberAndLengthAreBounded) {
  EventSeries series("c", "i");
  const int most = static_cast<int>(EventSeries::kMost);
  for (int i = 0; i < most; ++i) ASSERT_TRUE(series.Add(Lost(i), absl::UnixEpoch()));
  EXPECT_FALSE(series.Add(Lost(most), absl::UnixEpoch()));
  EXPECT_TRUE(series.Add(Lost(3), absl::UnixEpoch()));  // a repeat needs no room
  const auto write = series.Next(absl::UnixEpoch());
  series.Written(*write, "x");
  EXPECT_TRUE(series.Add(Lost(most), absl::UnixEpoch()));  // that one is forgotten
  Event chatter = Lost(5);
  chatter.message = std::string(100000, 'x');
  EventSeries other("c", "i");
  ASSERT_TRUE(other.Add(chatter, absl::UnixEpoch()));
  EXPECT_EQ(TextAt(other.Next(absl::UnixEpoch())->object, {"message"}).size(), 1000u);
}

class Recording : public testing::Test {
 protected:
  FakeApiServer server_;
  ApiClient client_{server_.Access()};
  EventRecorder recorder_{&client_, {"aureole-control", "pod-1", milliseconds(20)}};

  int64_t TotalCount() const {
    int64_t out = 0;
    for (const Json& event : server_.All(kEvents)) out += IntegerAt(event, {"count"}).value_or(0);
    return out;
  }
};

TEST_F(Recording, ThousandRepeatsAreOneEventAndFewRequests) {
  for (int i = 0; i < 1000; ++i) recorder_.Record(Lost(i % 2));
  ASSERT_TRUE(recorder_.Flush(seconds(20)));
  EXPECT_EQ(server_.All(kEvents).size(), 2u);
  EXPECT_EQ(TotalCount(), 1000);
  EXPECT_LT(recorder_.stats().written, 100);
  EXPECT_EQ(recorder_.stats().recorded, 1000);
  EXPECT_EQ(recorder_.stats().dropped, 0);
}

TEST_F(Recording, EventsThatWereRemovedAreMadeAnew) {
  recorder_.Record(Lost(1));
  ASSERT_TRUE(recorder_.Flush(seconds(20)));
  server_.Remove(absl::StrCat(kEvents, "/", TextAt(server_.All(kEvents).at(0), {"metadata", "name"})));
  recorder_.Record(Lost(1));
  ASSERT_TRUE(recorder_.Flush(seconds(20)));
  EXPECT_EQ(TotalCount(), 2);
}

TEST_F(Recording, ServerThatFailsIsTriedAgainThenLeftAlone) {
  server_.Inject({.kind = Fault::Kind::kStatus, .method = "POST", .times = 2, .status = 500});
  recorder_.Record(Lost(1));
  ASSERT_TRUE(recorder_.Flush(seconds(20)));
  EXPECT_EQ(TotalCount(), 1);
  EXPECT_EQ(recorder_.stats().failed, 2);
  server_.Inject({.kind = Fault::Kind::kStatus, .method = "POST", .times = 3, .status = 403});
  recorder_.Record(Lost(2));
  ASSERT_TRUE(recorder_.Flush(seconds(20)));
  EXPECT_EQ(recorder_.stats().dropped, 1);
}

TEST_F(Recording, NobodyWaitsForAServerThatHangs) {
  server_.Inject({.kind = Fault::Kind::kHang, .method = "POST", .times = 1000});
  const auto began = Clock::now();
  for (int i = 0; i < 10000; ++i) recorder_.Record(Lost(i));
  EXPECT_LT(Clock::now() - began, seconds(5));
  EXPECT_GE(recorder_.stats().dropped, 9000);
  EXPECT_FALSE(recorder_.Flush(milliseconds(50)));
  // And its end does not, either: see the time-out of this test.
}

}  // namespace
}  // namespace aureole::kubernetes
