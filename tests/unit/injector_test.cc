#include "server/core/injector.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <set>
#include <vector>

#include <gtest/gtest.h>

#include "server/core/world.h"

namespace aureole {
namespace {

constexpr int64_t kTickUs = 16000;

std::shared_ptr<const Shape> Sphere(double radius) {
  Shape shape;
  shape.radius = radius;
  return std::make_shared<const Shape>(shape);
}

Injector Example() {
  Injector injector;
  injector.rate = 160;
  injector.duration = 60;
  injector.volumes = {{Vec3(-10, 5, -75), Vec3(10, 25, 75), 1}, {Vec3(100, 5, 0), Vec3(120, 25, 20), 3}};
  injector.shapes = {{Sphere(0.3), 100, 1, {}, false}, {Sphere(0.5), 200, 1, {}, true}};
  injector.min_velocity = Vec3(-10, -10, -10);
  injector.max_velocity = Vec3(10, 0, 10);
  injector.max_spin = 2;
  return injector;
}

std::vector<Input> Spawns(const std::vector<Injector>& injectors, uint64_t seed, Tick first, Tick last) {
  std::vector<Input> out;
  for (Tick n = first; n <= last; ++n) InjectorInputs(injectors, seed, kTickUs, n, &out);
  return out;
}

TEST(Injector, MakesExactlyItsRateOverItsDuration) {
  const Injector injector = Example();
  EXPECT_EQ(InjectedBy(injector, kTickUs, 3750), 9600u) << "60 s";
  EXPECT_EQ(InjectedBy(injector, kTickUs, 1'000'000'000'000), 9600u) << "and no more for ever";
  EXPECT_EQ(Spawns({injector}, 1, 1, 5000).size(), 9600u);
}

TEST(Injector, MakesBodyQAtTheFirstTickNotBeforeItsTime) {
  Injector injector = Example();
  injector.start = 0.1;
  injector.rate = 7.001;
  for (Tick n = -5; n <= 4000; ++n) {
    // In thousandths of a microsecond: the number of q with start + q / rate <= n * tick.
    uint64_t expected = 0;
    if (n >= 1 && n * 16000 >= 100000)
      expected = static_cast<uint64_t>((n * 16000 - 100000) * 7001 / 1'000'000'000) + 1;
    expected = std::min<uint64_t>(expected, 421);  // 7.001 / s for 60 s: bodies 0 to 420
    ASSERT_EQ(InjectedBy(injector, kTickUs, n), expected) << n;
  }
}

TEST(Injector, NothingIsMadeBeforeTickOne) {
  const Injector injector = Example();
  EXPECT_EQ(InjectedBy(injector, kTickUs, -1), 0u);
  EXPECT_EQ(InjectedBy(injector, kTickUs, 0), 0u);
  EXPECT_EQ(InjectedBy(injector, kTickUs, 1), 3u) << "bodies 0, 1 and 2 are due at 0, 6.25 and 12.5 ms";
}

TEST(Injector, LongTimesDoNotOverflow) {
  Injector injector = Example();
  injector.rate = 1e5;
  injector.start = 1e7;
  injector.duration = 1e7;
  EXPECT_EQ(InjectedBy(injector, 1000, 10'000'000'000), 1u);
  EXPECT_EQ(InjectedBy(injector, 1000, 10'000'000'001), 101u);
  EXPECT_EQ(InjectedBy(injector, 1000, 40'000'000'000), 1'000'000'000'000u);
}

TEST(Injector, IsAPureFunctionOfSeedInjectorAndTick) {
  const std::vector<Injector> injectors = {Example(), Example()};
  const std::vector<Input> all = Spawns(injectors, 7, 1, 200);
  std::vector<Input> backwards;
  for (Tick n = 200; n >= 1; --n) {
    std::vector<Input> one;
    InjectorInputs(injectors, 7, kTickUs, n, &one);
    backwards.insert(backwards.begin(), one.begin(), one.end());
  }
  ASSERT_EQ(all.size(), backwards.size());
  for (size_t i = 0; i < all.size(); ++i) {
    EXPECT_EQ(all[i].tick, backwards[i].tick);
    ASSERT_EQ(all[i].body, backwards[i].body);
    EXPECT_EQ(all[i].spawn->position, backwards[i].spawn->position);
    EXPECT_EQ(all[i].spawn->velocity, backwards[i].spawn->velocity);
    EXPECT_EQ(all[i].spawn->orientation.coeffs(), backwards[i].spawn->orientation.coeffs());
    EXPECT_EQ(all[i].spawn->shape, backwards[i].spawn->shape);
  }
}

TEST(Injector, SeedsAndInjectorsDiffer) {
  const std::vector<Input> one = Spawns({Example(), Example()}, 1, 1, 10);
  const std::vector<Input> two = Spawns({Example(), Example()}, 2, 1, 10);
  std::set<double> xs;
  for (const Input& input : one) xs.insert(input.spawn->position.x());
  for (const Input& input : two) xs.insert(input.spawn->position.x());
  EXPECT_EQ(xs.size(), one.size() + two.size());
}

TEST(Injector, TheSameNumbersOnEveryMachine) {
  const std::vector<Input> spawns = Spawns({Example()}, 1, 1, 1);
  ASSERT_EQ(spawns.size(), 3u);
  EXPECT_EQ(spawns[2].spawn->position, Vec3(0x1.c76e48a4d4016p+6, 0x1.880bb90936bd1p+4, 0x1.41d56811427f2p+1));
  EXPECT_EQ(spawns[2].spawn->orientation.coeffs(),
            Quat(0x1.3c3fab1040e8ap-1, 0x1.c1f0135107398p-2, -0x1.ff92e2a74068p-6, -0x1.4d90174a9e8ap-1).coeffs());
}

TEST(Injector, BodiesAreWithinTheVolumesAndVelocities) {
  const Injector injector = Example();
  const std::vector<Input> spawns = Spawns({injector}, 3, 1, 3750);
  int in_second = 0, of_second = 0;
  Vec3 mean_velocity = Vec3::Zero();
  for (const Input& input : spawns) {
    const BodySpec& body = *input.spawn;
    const Injector::Volume& volume = injector.volumes[body.position.x() > 50 ? 1 : 0];
    in_second += body.position.x() > 50;
    of_second += body.ccd;
    mean_velocity += body.velocity / static_cast<double>(spawns.size());
    EXPECT_TRUE((body.position.array() >= volume.min.array()).all() &&
                (body.position.array() <= volume.max.array()).all());
    EXPECT_TRUE((body.velocity.array() >= injector.min_velocity.array()).all());
    EXPECT_TRUE((body.velocity.array() <= injector.max_velocity.array()).all());
    EXPECT_LE(body.angular_velocity.cwiseAbs().maxCoeff(), 2);
    EXPECT_NEAR(body.orientation.norm(), 1, 1e-12);
    EXPECT_EQ(body.mass, body.ccd ? 200 : 100);
    EXPECT_EQ(body.motion, Motion::kDynamic);
  }
  // Four standard deviations of the binomial and uniform distributions with 9600 draws.
  EXPECT_NEAR(in_second / 9600.0, 0.75, 0.018);
  EXPECT_NEAR(of_second / 9600.0, 0.5, 0.021);
  EXPECT_LT((mean_velocity - Vec3(0, -5, 0)).cwiseAbs().maxCoeff(), 0.24);
}

TEST(Injector, OrientationsAreUniform) {
  Vec3 up = Vec3::Zero();
  double squares = 0;
  for (const Input& input : Spawns({Example()}, 5, 1, 3750)) {
    const Vec3 turned = input.spawn->orientation * Vec3::UnitY();
    up += turned / 9600;
    squares += turned.y() * turned.y() / 9600;
  }
  EXPECT_LT(up.cwiseAbs().maxCoeff(), 0.024);
  EXPECT_NEAR(squares, 1.0 / 3, 0.012);
}

TEST(Injector, BodiesStandUprightWhenNotTurned) {
  Injector injector = Example();
  injector.random_orientation = false;
  for (const Input& input : Spawns({injector}, 5, 1, 10)) {
    EXPECT_EQ(input.spawn->orientation.coeffs(), Quat::Identity().coeffs());
  }
}

TEST(Injector, IdsNameTheInjectorAndTheNumber) {
  EXPECT_EQ(InjectedId(0, 0), 0x4000'0000'0000'0000u);
  EXPECT_EQ(InjectedId(3, 5), 0x4003'0000'0000'0005u);
  const std::vector<Input> spawns = Spawns({Example(), Example()}, 1, 1, 1);
  ASSERT_EQ(spawns.size(), 6u);
  EXPECT_EQ(spawns[4].body, InjectedId(1, 1));
  EXPECT_EQ(spawns[4].spawn->id, spawns[4].body);
}

TEST(ScriptedInputs, InjectedBodiesComeAfterTheFixedInputsInOrder) {
  World world(*Layout::Columns({}));
  world.injectors = {Example()};
  for (const Tick tick : {1, 2, 2, 4}) {
    Input input;
    input.tick = tick;
    input.sequence = world.script.size() + 1;
    input.body = 9;
    world.script.push_back(input);
  }
  std::vector<Input> inputs;
  ScriptedInputs(world, 2, &inputs);
  ASSERT_GT(inputs.size(), 2u);
  EXPECT_EQ(inputs[0].sequence, 2u);
  EXPECT_EQ(inputs[1].sequence, 3u);
  for (size_t i = 2; i < inputs.size(); ++i) EXPECT_EQ(inputs[i].kind, Input::Kind::kSpawn);
  for (size_t i = 1; i < inputs.size(); ++i) EXPECT_TRUE(inputs[i - 1] < inputs[i]);
  inputs.clear();
  world.injectors.clear();
  ScriptedInputs(world, 3, &inputs);
  EXPECT_TRUE(inputs.empty());
}

}  // namespace
}  // namespace aureole
