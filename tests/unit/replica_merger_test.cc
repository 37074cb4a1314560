// One world from the streams of several servers, whose frames overtake each other.
#include "client/src/replica_merger.h"

#include <google/protobuf/text_format.h>
#include <gtest/gtest.h>

#include <string>

namespace aureole::client {
namespace {

class Streams {
 public:
  // The next frame of a region's stream.
  void Take(int region, const std::string& text) {
    v1::ReplicaFrame frame;
    ASSERT_TRUE(google::protobuf::TextFormat::ParseFromString(text, &frame)) << text;
    ReplicaDecoder& decoder = region == 0 ? first_ : second_;
    frame.set_base_tick(decoder.tick());
    std::string error;
    ASSERT_TRUE(decoder.Apply(frame, &error)) << error;
    merger_.Apply(region, decoder, frame.more());
  }
  bool Shows(uint64_t body) const { return merger_.bodies().contains(body); }

 private:
  ReplicaDecoder first_{v1::FINE, false}, second_{v1::FINE, false};
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
  s.Take(0, NewBody(1, 0));
  s.Take(0, "tick: 3 cells { gone: 7 why: 3 moved_epoch: 1 moved_tick: 0 }");
  s.Take(1, "tick: 4");
  EXPECT_FALSE(s.Shows(7)) << "removed on its way, or out of view";
}

}  // namespace
}  // namespace aureole::client
