// A recording that differs from what is simulated: the first body is named.
#include "server/replay/replay.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <map>
#include <vector>

#include "server/core/region.h"
#include "server/physics/bullet_engine.h"
#include "server/transport/input_codec.h"
#include "server/transport/world_spec.h"

namespace aureole {
namespace {

using testing::HasSubstr;

v1::WorldSpec Falling() {
  v1::WorldSpec spec;
  spec.set_name("falling");
  v1::Body* b = spec.add_bodies();
  b->set_id(10);
  b->mutable_shape()->mutable_sphere()->set_radius(0.5);
  b->mutable_array()->set_x(4);
  b->mutable_array()->mutable_spacing()->set_x(3);
  spec.add_statics()->mutable_shape()->mutable_plane()->mutable_normal()->set_y(1);
  return spec;
}

// The world of one region, as its server would tell it.
class Recorded {
 public:
  Recorded() : world_(WorldFromSpec(Falling()).value()), region_(world_, 0, MakeBulletEngine(world_.environment)) {}

  void RunTo(Tick n) {
    std::vector<Frame> out;
    while (region_.tick() < n) region_.Advance(&out);
  }
  v1::Snapshot Snapshot() const {
    v1::Snapshot out;
    out.set_tick(region_.tick());
    *out.mutable_world() = Falling();
    RegionSnapshot s = region_.Snapshot();
    out.set_state(s.state);
    RecordInputs(s.to_come, out.mutable_to_come());
    return out;
  }
  std::map<BodyId, uint64_t> Hashes() const {
    std::map<BodyId, uint64_t> out;
    for (BodyId id : region_.engine().Ids()) out[id] = region_.engine().Hash(id);
    return out;
  }

 private:
  const World world_;
  Region region_;
};

TEST(Replay, NamesTheFirstBodyThatDiffers) {
  Recorded recorded;
  recorded.RunTo(20);
  absl::StatusOr<std::unique_ptr<Replay>> replay = Replay::Begin({recorded.Snapshot()});
  ASSERT_TRUE(replay.ok()) << replay.status();
  EXPECT_EQ((*replay)->tick(), 20);
  EXPECT_EQ((*replay)->bodies(), 4);
  recorded.RunTo(50);
  (*replay)->RunTo(50);
  std::map<BodyId, uint64_t> hashes = recorded.Hashes();
  EXPECT_FALSE((*replay)->Compare(hashes).has_value());

  std::map<BodyId, uint64_t> other = hashes;
  ++other[12];
  ++other[13];
  EXPECT_EQ((*replay)->Compare(other)->body, 12u);
  other = hashes;
  other.erase(11);
  EXPECT_EQ((*replay)->Compare(other)->body, 11u);
  EXPECT_EQ((*replay)->Compare(other)->recorded, 0u);
  other = hashes;
  other[99] = 5;
  EXPECT_EQ((*replay)->Compare(other)->body, 99u);
  EXPECT_EQ((*replay)->Compare(other)->simulated, 0u);
}

TEST(Replay, AnInputThatIsMissingMakesItDiffer) {
  Recorded recorded;
  recorded.RunTo(20);
  absl::StatusOr<std::unique_ptr<Replay>> replay = Replay::Begin({recorded.Snapshot()});
  ASSERT_TRUE(replay.ok()) << replay.status();
  Input kick;
  kick.tick = 30;
  kick.source = kick.sequence = 1;
  kick.body = 11;
  kick.linear = Vec3(0, 3, 0);
  google::protobuf::RepeatedPtrField<v1::Input> all;
  RecordInputs({kick}, &all);
  const v1::Input& told = all[0];
  ASSERT_TRUE((*replay)->Add(told).ok());
  recorded.RunTo(29);
  (*replay)->RunTo(29);
  EXPECT_FALSE((*replay)->Compare(recorded.Hashes()).has_value());
  recorded.RunTo(30);
  (*replay)->RunTo(30);
  EXPECT_EQ((*replay)->Compare(recorded.Hashes())->body, 11u);
  EXPECT_THAT(std::string((*replay)->Add(told).message()), HasSubstr("acts at tick 30, which is over"));
}

TEST(Replay, SnapshotsThatAreNoneOrOfDifferentTicksAreRefused) {
  Recorded recorded;
  recorded.RunTo(5);
  const v1::Snapshot first = recorded.Snapshot();
  recorded.RunTo(6);
  EXPECT_THAT(std::string(Replay::Begin({first, recorded.Snapshot()}).status().message()), HasSubstr("is of tick 6"));
  EXPECT_THAT(std::string(Replay::Begin({first, first}).status().message()), HasSubstr("already here"));
  EXPECT_FALSE(Replay::Begin({}).ok());
  v1::Snapshot broken = first;
  broken.mutable_state()->resize(broken.state().size() / 2);
  EXPECT_FALSE(Replay::Begin({broken}).ok());
}

}  // namespace
}  // namespace aureole
