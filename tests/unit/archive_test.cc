#include "server/core/archive.h"

#include <limits>

#include <gtest/gtest.h>

#include "server/core/live_inputs.h"

namespace aureole {
namespace {

template <class T>
std::string Saved(const T& value) {
  std::string out;
  Writer writer(&out);
  writer(value);
  return out;
}

Input Force(uint64_t sequence) {
  Input i;
  i.source = 3;
  i.sequence = sequence;
  i.body = 9;
  i.linear = Vec3(1, -0.0, std::numeric_limits<double>::denorm_min());
  i.ticks = 7;
  return i;
}

Input Spawn(uint64_t sequence) {
  auto ball = std::make_shared<Shape>();
  ball->radius = 0.25;
  auto both = std::make_shared<Shape>();
  both->kind = ShapeKind::kCompound;
  both->children = {{Vec3(1, 2, 3), Quat::Identity(), ball}, {Vec3(0, 0, 1), Quat(0.5, 0.5, 0.5, 0.5), ball}};
  auto body = std::make_shared<BodySpec>();
  body->shape = both;
  body->position = Vec3(4, 5, 6);
  Input i;
  i.source = 4;
  i.sequence = sequence;
  i.kind = Input::Kind::kSpawn;
  i.spawn = body;
  return i;
}

// Everything that regions remember of clients: what is loaded says the same again, byte by byte, and goes on the same.
TEST(Archive, LoadedInputsGoOnAsThoseThatWereSaved) {
  LiveInputs first;
  ASSERT_TRUE(first.Offer(Force(1)).ok());
  first.Deliver({Force(1), Spawn(1)}, 5, 6, true);
  first.Deliver({Force(1), Force(2)}, 6, 7, true);
  ASSERT_TRUE(first.Offer(Spawn(2)).ok());
  const std::string saved = Saved(first);

  LiveInputs second;
  Reader reader(saved);
  reader(second);
  ASSERT_TRUE(reader.done());
  EXPECT_EQ(Saved(second), saved);
  for (LiveInputs* l : {&first, &second}) {
    l->TakeDelivered();
    l->Deliver({Spawn(1), Spawn(2)}, 8, 9, false);
  }
  const std::vector<Input> a = first.TakeDelivered(), b = second.TakeDelivered();
  ASSERT_EQ(a.size(), 1);
  ASSERT_EQ(b.size(), 1);
  EXPECT_EQ(a[0].body, kFirstLiveId + 1);
  EXPECT_EQ(b[0].body, a[0].body);
  ASSERT_EQ(b[0].spawn->shape->children.size(), 2);
  EXPECT_EQ(b[0].spawn->shape->children[1].orientation.coeffs(), Quat(0.5, 0.5, 0.5, 0.5).coeffs());
}

TEST(Archive, ReaderStopsAtTheEndOfWhatIsThere) {
  LiveInputs inputs;
  inputs.Deliver({Force(1), Spawn(1)}, 5, 6, true);
  const std::string saved = Saved(inputs);
  for (size_t n = 0; n < saved.size(); ++n) {
    LiveInputs out;
    Reader reader(std::string_view(saved).substr(0, n));
    reader(out);
    EXPECT_FALSE(reader.done()) << n;
  }
}

TEST(Archive, CountThatIsNotThereTakesNoMemory) {
  std::vector<double> numbers;
  Reader reader(
      "\xff\xff\xff\xff\xff\xff\xff\x7f"
      "12345678");
  reader(numbers);
  EXPECT_FALSE(reader.ok());
  EXPECT_TRUE(numbers.empty());
}

}  // namespace
}  // namespace aureole
