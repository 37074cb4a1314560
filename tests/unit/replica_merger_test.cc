// One world from the streams of several servers, whose frames overtake each other, and which come and go.
#include "client/src/replica_merger.h"

#include <google/protobuf/text_format.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <string>
#include <vector>

namespace aureole::client {
namespace {

class Streams {
 public:
  Streams() { Follow(1, {0, 1}); }

  // Streams of regions that are no more end; the frames that follow are of this layout.
  void Follow(uint64_t epoch, const std::vector<int32_t>& regions) {
    epoch_ = epoch;
    std::erase_if(decoders_,
                  [&](const auto& d) { return std::find(regions.begin(), regions.end(), d.first) == regions.end(); });
    merger_.Follow(epoch, regions);
  }
  // The stream of this region was lost; its next frame begins another.
  void Lose(int region) { decoders_.erase(region); }
  // The next frame of a region's stream. `epoch`: 0: that of the layout.
  void Take(int region, const std::string& text, uint64_t epoch = 0) {
    v1::ReplicaFrame frame;
    ASSERT_TRUE(google::protobuf::TextFormat::ParseFromString(text, &frame)) << text;
    ReplicaDecoder& decoder = decoders_.try_emplace(region, v1::FINE, false).first->second;
    frame.set_base_tick(decoder.tick());
    frame.set_layout_epoch(epoch == 0 ? epoch_ : epoch);
    std::string error;
    ASSERT_TRUE(decoder.Apply(frame, &error)) << error;
    merger_.Apply(region, decoder, frame);
  }
  bool Shows(uint64_t body) const { return merger_.bodies().contains(body); }
  int RegionOf(uint64_t body) const { return merger_.bodies().at(body).region; }

 private:
  uint64_t epoch_ = 0;
  std::map<int, ReplicaDecoder> decoders_;
  ReplicaMerger merger_;
};

// Body 7 in the cell at the origin, with this epoch.
std::string NewBody(int tick, int epoch) {
  return "tick: " + std::to_string(tick) + " cells { new_id: 7 new_epoch: " + std::to_string(epoch) +
         " new_position: 9 new_position: 9 new_position: 9 new_orientation: 0 new_orientation: 0 new_orientation: 0 "
         "new_largest: 3 }";
}

constexpr char kMoves[] =
    " cells { id: 7 position: 1 position: 0 position: 0 orientation: 0 orientation: 0 orientation: 0 }";

TEST(ReplicaMerger, LateWordOfAFormerServerDoesNotBringARemovedBodyBack) {
  Streams s;
  s.Take(0, NewBody(1, 0));
  s.Take(1, "tick: 1");
  s.Take(1, NewBody(3, 1));  // handed over at tick 3
  s.Take(1, "tick: 5 cells { gone: 7 why: 1 }");
  EXPECT_FALSE(s.Shows(7));
  s.Take(0, std::string("tick: 2") + kMoves);
  EXPECT_FALSE(s.Shows(7)) << "what region 0 tells is older than the removal";
  s.Take(0, "tick: 3 cells { gone: 7 why: 3 moved_epoch: 1 moved_tick: 0 }");
  s.Take(1, "tick: 6");
  EXPECT_FALSE(s.Shows(7));
}

TEST(ReplicaMerger, BodyThatWasHandedOverStaysUntilItsNewServerHasToldAll) {
  Streams s;
  s.Take(0, NewBody(1, 0));
  s.Take(0, "tick: 3 cells { gone: 7 why: 3 moved_epoch: 1 moved_tick: 0 }");
  EXPECT_TRUE(s.Shows(7));
  s.Take(1, "tick: 3 more: true");  // its cell comes with a later frame
  EXPECT_TRUE(s.Shows(7));
  s.Take(1, NewBody(4, 1));
  EXPECT_TRUE(s.Shows(7));
}

TEST(ReplicaMerger, BodyThatItsNewServerDoesNotHaveIsGone) {
  Streams s;
  s.Take(1, "tick: 1");
  s.Take(0, NewBody(1, 0));
  s.Take(0, "tick: 3 cells { gone: 7 why: 3 moved_epoch: 1 moved_tick: 0 }");
  s.Take(1, "tick: 4");
  EXPECT_FALSE(s.Shows(7)) << "removed on its way, or out of view";
}

TEST(ReplicaMerger, BodyThatWentOnBeforeItsNewServersStreamBeganStaysUntilAThirdTellsIt) {
  Streams s;
  s.Follow(2, {0, 1, 2});
  s.Take(0, NewBody(1, 0));
  s.Take(0, "tick: 3 cells { gone: 7 why: 3 moved_epoch: 1 moved_tick: 0 }");
  s.Take(1, "tick: 5");  // it gave it to region 2 at tick 4
  EXPECT_TRUE(s.Shows(7));
  s.Take(0, "tick: 6");
  s.Take(1, "tick: 6");
  EXPECT_TRUE(s.Shows(7)) << "region 2 has told nothing yet";
  s.Take(2, NewBody(5, 2));
  EXPECT_EQ(s.RegionOf(7), 2);
}

TEST(ReplicaMerger, BodiesOfARegionThatLeavesStayUntilOthersTellThem) {
  Streams s;
  s.Take(0, "tick: 1");
  s.Take(1, NewBody(1, 0));  // its last frame: that it hands the body over at tick 3 is never read
  s.Follow(2, {0, 2});
  EXPECT_TRUE(s.Shows(7));
  s.Take(0, "tick: 2", 1);
  s.Take(2, "tick: 2", 1);
  s.Take(0, "tick: 3", 1);
  s.Take(2, "tick: 3", 1);
  EXPECT_TRUE(s.Shows(7)) << "these are frames of the layout before";
  s.Take(0, "tick: 9");
  s.Take(2, "tick: 7 more: true");
  EXPECT_TRUE(s.Shows(7)) << "region 2 has not told all";
  s.Take(2, NewBody(8, 1));
  EXPECT_EQ(s.RegionOf(7), 2);
  for (int tick = 10; tick < 14; ++tick) {
    s.Take(0, "tick: " + std::to_string(tick));
    s.Take(2, "tick: " + std::to_string(tick));
  }
  EXPECT_TRUE(s.Shows(7));
}

TEST(ReplicaMerger, BodyOfARegionThatHasLeftWhichNobodyHasIsGone) {
  Streams s;
  s.Take(0, "tick: 1");
  s.Take(1, NewBody(1, 0));  // removed at tick 2, which is never read
  s.Follow(2, {0, 2});
  s.Take(0, "tick: 9");
  s.Take(2, "tick: 7");
  EXPECT_TRUE(s.Shows(7)) << "region 0 may have handed it to region 2 at tick 8";
  s.Take(2, "tick: 8");
  EXPECT_TRUE(s.Shows(7));
  s.Take(2, "tick: 9");
  EXPECT_FALSE(s.Shows(7));
}

TEST(ReplicaMerger, BodyThatIsHandedToARegionThatLeavesGoesOnFromThere) {
  Streams s;
  s.Follow(2, {0, 1, 2});
  s.Take(0, NewBody(1, 0));
  s.Take(0, "tick: 3 cells { gone: 7 why: 3 moved_epoch: 1 moved_tick: 0 }");
  s.Follow(3, {0, 2});  // region 1 gave it to region 2 before it left
  s.Take(0, "tick: 9");
  EXPECT_TRUE(s.Shows(7));
  s.Take(2, NewBody(9, 2));
  EXPECT_EQ(s.RegionOf(7), 2);
  Streams gone;
  gone.Follow(2, {0, 1, 2});
  gone.Take(0, NewBody(1, 0));
  gone.Take(0, "tick: 3 cells { gone: 7 why: 3 moved_epoch: 1 moved_tick: 0 }");
  gone.Follow(3, {0, 2});
  gone.Take(0, "tick: 9");
  gone.Take(2, "tick: 9");
  EXPECT_FALSE(gone.Shows(7)) << "removed before region 1 left";
  // And when it is heard of after the region has left.
  Streams late;
  late.Take(0, NewBody(1, 0));
  late.Follow(3, {0, 2});
  late.Take(2, "tick: 9");
  late.Take(0, "tick: 3 cells { gone: 7 why: 3 moved_epoch: 1 moved_tick: 0 }");
  EXPECT_TRUE(late.Shows(7));
  late.Take(0, "tick: 9");
  EXPECT_FALSE(late.Shows(7)) << "all have told tick 9, and none has it";
}

TEST(ReplicaMerger, BodyThatIsHandedToARegionOfTheNextLayoutWaitsForIt) {
  Streams s;
  s.Take(1, "tick: 4", 2);
  s.Take(0, NewBody(1, 0));
  s.Take(0, "tick: 4 cells { gone: 7 why: 4 moved_epoch: 1 moved_tick: 0 }", 2);
  s.Take(0, "tick: 5", 2);
  s.Take(1, "tick: 5", 2);
  EXPECT_TRUE(s.Shows(7));
  s.Follow(2, {0, 1, 2});
  s.Take(0, "tick: 6");
  s.Take(1, "tick: 6");
  EXPECT_TRUE(s.Shows(7));
  s.Take(2, NewBody(6, 1));
  EXPECT_EQ(s.RegionOf(7), 2);
}

TEST(ReplicaMerger, BodyThatComesToAServerAgainAfterItWasReplacedStays) {
  Streams s;
  s.Take(0, NewBody(1, 0));
  s.Take(1, "tick: 1");
  s.Take(1, NewBody(5, 1));  // handed over at tick 5
  s.Take(0, "tick: 7 cells { gone: 7 why: 3 moved_epoch: 1 moved_tick: -2 }");
  s.Lose(1);
  s.Take(1, "tick: 3");  // it begins at its checkpoint again
  EXPECT_TRUE(s.Shows(7));
  s.Take(1, "tick: 4");
  EXPECT_TRUE(s.Shows(7));
  s.Take(1, NewBody(5, 1));
  EXPECT_EQ(s.RegionOf(7), 1);
  s.Take(1, "tick: 7");
  s.Take(0, "tick: 8");
  s.Take(1, "tick: 8");
  EXPECT_TRUE(s.Shows(7));
}

TEST(ReplicaMerger, BodyThatIsGoneWhenAStreamIsOpenedAgainGoesWithIt) {
  Streams s;
  s.Take(0, "tick: 1");
  s.Take(1, NewBody(1, 0));
  s.Lose(1);
  s.Take(0, "tick: 5");
  s.Take(1, "tick: 5");  // it was removed meanwhile
  EXPECT_FALSE(s.Shows(7));
}

}  // namespace
}  // namespace aureole::client
