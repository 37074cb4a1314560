// Worlds whose regions are counted, and become more or fewer while they run: by whoever asks for it, and by the load.
#include <gtest/gtest.h>
#include <signal.h>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>

#include "tests/kubernetes/world_life.h"

namespace aureole::kubernetes {
namespace {

// Budgets count by it; without it, no Pod may ever be evicted.
TEST_F(WorldLife, WorldThatDoesNotSayHowManyRegionsItHasIsGivenThem) {
  const auto replicas = [this] { return IntegerAt(cluster_.World("w"), {"spec", "replicas"}).value_or(0); };
  cluster_.api().Inject({.method = "PATCH", .target = "/worlds/w/scale", .status = 403});
  seconds_ = 16;
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(Await([&] { return HasEvent("CannotScale"); }));
  ASSERT_TRUE(Await([&] { return replicas() == 2; })) << "it is tried again";
  cluster_.api().Merge(absl::StrCat(kWorlds, "w"), {{"spec", {{"replicas", 3}}}});
  ASSERT_TRUE(Await([&] { return TextAt(Status(), {"regionsReady"}) == "3/3"; }));
  EXPECT_EQ(replicas(), 3) << "that was the operator's word";
  EXPECT_EQ(cluster_.api().Count("PATCH /apis/aureole.dev/v1alpha1/namespaces/test/worlds/w/scale"), 2);
  ExpectEndAsUndisturbed();
}

TEST_F(WorldLife, ScaledWorldGetsAndLosesServersAndNoBitChanges) {
  seconds_ = 16;  // so that a slow machine gets there before the end
  cluster_.StartControl(0);
  Create(Spec());
  ASSERT_TRUE(AwaitTick(20));
  for (const int replicas : {4, 3}) {
    cluster_.api().Merge(absl::StrCat(kWorlds, "w"), {{"spec", {{"replicas", replicas}}}});
    const std::string all = absl::StrCat(replicas, "/", replicas);
    ASSERT_TRUE(Await([&] {
      return TextAt(Status(), {"regionsReady"}) == all && cluster_.processes() == static_cast<size_t>(replicas);
    })) << Status().dump(1);
    EXPECT_EQ(IntegerAt(Status(), {"replicas"}), replicas);
  }
  EXPECT_EQ(Condition("Applied", "status"), "True");
  cluster_.api().Merge(absl::StrCat(kWorlds, "w"), {{"spec", {{"replicas", 65}}}});
  ASSERT_TRUE(Await([&] { return Condition("Applied", "status") == "False"; }));
  EXPECT_TRUE(absl::StartsWith(Condition("Applied", "message"), "spec.replicas: is 65"));
  ExpectEndAsUndisturbed();
}

// 230 bodies fall at once and are struck; after ten seconds most of them sleep.
TEST_F(WorldLife, WorldScalesItselfByItsLoadAndNoBitChanges) {
  seconds_ = 20;
  cluster_.StartControl(0);
  Json spec = Spec();
  spec["regions"] = {
      {"max", 5}, {"framePercent", 1000}, {"awakeBodies", 150}, {"upAfter", "300ms"}, {"downAfter", "1s"}};
  spec["replicas"] = 1;
  Create(spec);
  const auto members = [this] { return IntegerAt(Status(), {"replicas"}).value_or(0); };
  ASSERT_TRUE(Await([&] { return members() > 2; })) << Status().dump(1);
  const int64_t most = IntegerAt(cluster_.World("w"), {"spec", "replicas"}).value_or(0);
  EXPECT_GT(most, 2);
  EXPECT_LE(most, 5);
  ASSERT_TRUE(Await([&] { return members() < most; })) << Status().dump(1);
  EXPECT_TRUE(Await([&] { return HasEvent("Scaled"); }));
  EXPECT_EQ(Condition("Applied", "status"), "True");
  ExpectEndAsUndisturbed();
}

TEST_F(WorldLife, IdleWorldShrinksToItsLeastAndAWishLastsForATime) {
  cluster_.StartControl(0);
  cluster_.api().Inject({.kind = Fault::Kind::kStatus, .method = "PATCH", .target = "/worlds/w/scale", .status = 403});
  Json spec = Spec();
  spec.erase("duration");
  spec["replicas"] = 12;  // too many
  spec["regions"] = {{"min", 1},
                     {"max", 3},
                     {"framePercent", 1000},
                     {"awakeBodies", 1000000},
                     {"upAfter", "200ms"},
                     {"downAfter", "1500ms"}};
  Create(spec);
  const auto is = [this](int regions) {  // and the next control plane would know of those that have left
    return Find(Status(), {"record", "leaving"}) == nullptr &&
           IntegerAt(cluster_.World("w"), {"spec", "replicas"}) == regions &&
           TextAt(Status(), {"regionsReady"}) == absl::StrCat(regions, "/", regions) &&
           cluster_.processes() == static_cast<size_t>(regions);
  };
  ASSERT_TRUE(Await([&] { return is(1); })) << Status().dump(1);
  EXPECT_TRUE(Await([&] { return HasEvent("CannotScale"); }));
  cluster_.api().Merge(absl::StrCat(kWorlds, "w"), {{"spec", {{"replicas", 3}}}});
  ASSERT_TRUE(Await([&] { return is(3); })) << Status().dump(1);
  ASSERT_TRUE(Await([&] { return is(1); })) << Status().dump(1);
  // The next control plane goes on from there, with other bounds, and fills in what is not there any more.
  cluster_.SignalControl(0, SIGKILL);
  cluster_.StartControl(1);
  cluster_.api().Merge(absl::StrCat(kWorlds, "w"), {{"spec", {{"regions", {{"min", 2}}}, {"replicas", nullptr}}}});
  ASSERT_TRUE(Await([&] { return is(2); })) << Status().dump(1);
}

}  // namespace
}  // namespace aureole::kubernetes
