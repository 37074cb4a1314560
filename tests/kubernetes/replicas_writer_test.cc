// A World that has no number of regions is given one, once, and nobody's own is touched.
#include "server/control/kubernetes/replicas_writer.h"

#include <gtest/gtest.h>

#include "tests/kubernetes/await.h"
#include "tests/kubernetes/fake_api_server.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;

constexpr char kWorld[] = "/apis/aureole.dev/v1alpha1/namespaces/test/worlds/w";

class ReplicasWriterTest : public testing::Test {
 protected:
  ReplicasWriterTest() { server_.Put(kWorld, {{"spec", {{"a", 1}}}, {"status", {{"tick", 5}}}}); }
  Json World() { return *server_.At(kWorld); }

  FakeApiServer server_;
  ApiClient client_{server_.Access()};
  ReplicasWriter writer_{&client_, "test", "w", milliseconds(100)};
};

TEST_F(ReplicasWriterTest, WorldThatHasNoneIsGivenThemOnce) {
  const Json before = World();
  for (int i = 0; i < 5; ++i) ASSERT_TRUE(writer_.Look(before, 4).ok());  // what is known of it may be old
  EXPECT_EQ(World()["spec"], (Json{{"a", 1}, {"replicas", 4}}));
  EXPECT_EQ(World()["status"], before["status"]);
  ASSERT_TRUE(writer_.Look(World(), 6).ok());
  EXPECT_EQ(server_.Count("PATCH"), 1);
  EXPECT_EQ(server_.Count("PATCH /apis/aureole.dev/v1alpha1/namespaces/test/worlds/w/scale"), 1)
      << "the account may not write other fields";
}

TEST_F(ReplicasWriterTest, NumberThatIsTakenAwayIsGivenAgain) {
  ASSERT_TRUE(writer_.Look(World(), 4).ok());
  server_.Merge(kWorld, {{"spec", {{"replicas", nullptr}}}});
  ASSERT_TRUE(Await([&] {
    EXPECT_TRUE(writer_.Look(World(), 4).ok());
    return IntegerAt(World(), {"spec", "replicas"}) == 4;
  }));
}

TEST_F(ReplicasWriterTest, FailureIsToldAndTriedAgainAfterAWhile) {
  server_.Inject({.method = "PATCH", .status = 403});
  EXPECT_TRUE(absl::IsPermissionDenied(writer_.Look(World(), 4)));
  EXPECT_TRUE(writer_.Look(World(), 4).ok());
  EXPECT_EQ(server_.Count("PATCH"), 1) << "not at once";
  ASSERT_TRUE(Await([&] {
    EXPECT_TRUE(writer_.Look(World(), 4).ok());
    return World()["spec"].contains("replicas");
  }));
}

}  // namespace
}  // namespace aureole::kubernetes
