#include "tests/bench/heap_world.h"

#include <memory>
#include <utility>

namespace aureole {
namespace {

std::shared_ptr<const Shape> MakeShape(int i) {
  auto s = std::make_shared<Shape>();
  const double size = 0.3 + 0.02 * (i % 7);
  switch (i % 3) {
    case 0:
      s->kind = ShapeKind::kSphere;
      s->radius = size;
      break;
    case 1:
      s->kind = ShapeKind::kBox;
      s->half = Vec3(size, 0.8 * size, 1.2 * size);
      break;
    default:
      s->kind = ShapeKind::kCapsule;
      s->radius = 0.7 * size;
      s->half.y() = 1.5 * size;
  }
  return s;
}

BodySpec Fixed(BodyId id, std::shared_ptr<const Shape> shape, const Vec3& position) {
  BodySpec b;
  b.id = id;
  b.motion = Motion::kStatic;
  b.shape = std::move(shape);
  b.position = position;
  return b;
}

}  // namespace

World HeapWorld(int bodies) {
  World world(Layout::Columns({}).value());
  world.environment.sleep_linear = 0;
  auto plane = std::make_shared<Shape>();
  plane->kind = ShapeKind::kPlane;
  world.environment.fixed.push_back(Fixed(1, plane, Vec3::Zero()));
  for (int wall = 0; wall < 4; ++wall) {
    auto box = std::make_shared<Shape>();
    box->kind = ShapeKind::kBox;
    box->half = wall < 2 ? Vec3(0.5, 10, 6) : Vec3(6, 10, 0.5);
    const double at = wall % 2 == 0 ? -5 : 5;
    world.environment.fixed.push_back(
        Fixed(2 + static_cast<BodyId>(wall), box, wall < 2 ? Vec3(at, 10, 0) : Vec3(0, 10, at)));
  }
  for (int i = 0; i < bodies; ++i) {
    BodySpec b;
    b.id = 1000 + static_cast<BodyId>(i);
    b.shape = MakeShape(i);
    b.mass = 1 + 0.1 * (i % 11);
    b.position = Vec3(-3.6 + 1.2 * (i % 7), 1 + 1.1 * (i / 49), -3.6 + 1.2 * (i / 7 % 7));
    b.orientation = Quat(Eigen::AngleAxisd(0.1 * i, Vec3(1, 2, 3).normalized()));
    world.bodies.push_back(std::move(b));
  }
  return world;
}

}  // namespace aureole
