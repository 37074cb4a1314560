// What a list and a watch make of the copy, and which changes are told.
#include <gtest/gtest.h>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_join.h>

#include "server/control/kubernetes/object_cache.h"

namespace aureole::kubernetes {
namespace {

using Kind = WatchEvent::Kind;

Json Item(const std::string& name, const std::string& uid, const std::string& version) {
  return {{"metadata", {{"namespace", "n"}, {"name", name}, {"uid", uid}, {"resourceVersion", version}}}};
}

// "+a/u1@1 ~b/u2@5 -c/u3@2"
std::string Taken(ObjectCache& cache) {
  return absl::StrJoin(cache.Take(), " ", [](std::string* out, const Change& change) {
    const char* const sign = change.kind == Change::Kind::kAdded      ? "+"
                             : change.kind == Change::Kind::kModified ? "~"
                                                                      : "-";
    absl::StrAppend(out, sign, TextAt(*change.object, {"metadata", "name"}), "/",
                    TextAt(*change.object, {"metadata", "uid"}), "@",
                    TextAt(*change.object, {"metadata", "resourceVersion"}));
  });
}

TEST(ObjectCache, ListIsDiffedAgainstTheCopy) {
  ObjectCache cache;
  ASSERT_TRUE(cache.Replace({Item("a", "u1", "1"), Item("b", "u2", "2"), Item("c", "u3", "3")}).ok());
  EXPECT_EQ(Taken(cache), "+a/u1@1 +b/u2@2 +c/u3@3");
  // b has changed, c is gone, d is new; and a is of the same name, but another object.
  ASSERT_TRUE(cache.Replace({Item("a", "u4", "7"), Item("b", "u2", "5"), Item("d", "u5", "6")}).ok());
  EXPECT_EQ(Taken(cache), "-c/u3@3 -a/u1@1 +a/u4@7 ~b/u2@5 +d/u5@6");
  ASSERT_TRUE(cache.Replace({Item("a", "u4", "7"), Item("b", "u2", "5"), Item("d", "u5", "6")}).ok());
  EXPECT_EQ(Taken(cache), "");
  EXPECT_EQ(cache.objects().size(), 3u);
  EXPECT_TRUE(cache.objects().contains("n/d"));
}

TEST(ObjectCache, EventsAreAppliedWhateverTheCopyHad) {
  ObjectCache cache;
  const auto apply = [&](Kind kind, Json object) { ASSERT_TRUE(cache.Apply({kind, std::move(object)}).ok()); };
  apply(Kind::kModified, Item("a", "u1", "1"));  // not seen before
  EXPECT_EQ(Taken(cache), "+a/u1@1");
  apply(Kind::kAdded, Item("a", "u1", "2"));
  EXPECT_EQ(Taken(cache), "~a/u1@2");
  apply(Kind::kAdded, Item("a", "u1", "2"));  // told twice
  apply(Kind::kDeleted, Item("b", "u2", "3"));
  apply(Kind::kBookmark, Json::object());
  EXPECT_EQ(Taken(cache), "");
  apply(Kind::kAdded, Item("a", "u3", "4"));    // its deletion was missed
  apply(Kind::kDeleted, Item("a", "u1", "5"));  // and comes late
  EXPECT_EQ(Taken(cache), "-a/u1@2 +a/u3@4");
  apply(Kind::kDeleted, Item("a", "u3", "6"));
  EXPECT_EQ(Taken(cache), "-a/u3@6");
  EXPECT_TRUE(cache.objects().empty());
}

TEST(ObjectCache, ChangesOfAnObjectAreOneUntilTheyAreTaken) {
  ObjectCache cache;
  const auto apply = [&](Kind kind, Json object) { ASSERT_TRUE(cache.Apply({kind, std::move(object)}).ok()); };
  ASSERT_TRUE(cache.Replace({Item("a", "u1", "1"), Item("b", "u2", "1")}).ok());
  cache.Take();
  for (int i = 2; i < 1000; ++i) apply(Kind::kModified, Item("a", "u1", std::to_string(i)));
  apply(Kind::kModified, Item("b", "u2", "2"));
  EXPECT_EQ(Taken(cache), "~a/u1@999 ~b/u2@2");
  apply(Kind::kModified, Item("a", "u1", "3"));
  apply(Kind::kDeleted, Item("a", "u1", "4"));
  apply(Kind::kAdded, Item("a", "u9", "5"));
  apply(Kind::kModified, Item("a", "u9", "6"));
  EXPECT_EQ(Taken(cache), "-a/u1@4 +a/u9@6");
  // Come and gone between two looks.
  apply(Kind::kAdded, Item("c", "u3", "7"));
  apply(Kind::kDeleted, Item("c", "u3", "8"));
  EXPECT_EQ(Taken(cache), "");
  // Gone, and back by a list of an older server.
  apply(Kind::kDeleted, Item("b", "u2", "9"));
  ASSERT_TRUE(cache.Replace({Item("a", "u9", "6"), Item("b", "u2", "2")}).ok());
  EXPECT_EQ(Taken(cache), "~b/u2@2");
}

TEST(ObjectCache, ObjectsWithoutIdentityAreRefusedAndChangeNothing) {
  ObjectCache cache;
  ASSERT_TRUE(cache.Replace({Item("a", "u1", "1")}).ok());
  EXPECT_TRUE(absl::IsDataLoss(cache.Replace({Item("b", "u2", "1"), Item("c", "", "1")})));
  EXPECT_TRUE(absl::IsDataLoss(cache.Apply({Kind::kAdded, Item("", "u2", "1")})));
  EXPECT_TRUE(absl::IsDataLoss(cache.Apply({Kind::kAdded, Json::array()})));
  EXPECT_EQ(Taken(cache), "+a/u1@1");
}

}  // namespace
}  // namespace aureole::kubernetes
