// Bullet shapes made from ours, shared by all bodies whose shapes have equal content.
#pragma once

#include <map>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "server/core/scene.h"
#include "server/physics/bullet.h"

namespace aureole::physics {

// Immutable. What Bullet needs of a shape, and what we derive from it once.
struct CollisionShape {
  // A convex or concave piece with its own contacts: compounds have one per child, all others one.
  struct Part {
    const btCollisionShape* shape = nullptr;
    btTransform local = btTransform::getIdentity();
  };
  ShapeKind kind = ShapeKind::kSphere;
  std::string bytes;  // codec.h; its identity
  btCollisionShape* whole = nullptr;
  std::vector<Part> parts;
  double reach = 0;     // m; the box of the shape in any orientation lies within this cube about its origin
  double smallest = 0;  // m; half of its smallest extent
  std::vector<std::unique_ptr<btCollisionShape>> owned;
  std::shared_ptr<const Shape> source;  // owns the vertices that Bullet refers to
  std::unique_ptr<btStridingMeshInterface> mesh;

  bool compound() const { return kind == ShapeKind::kCompound; }
};

// Belongs to one engine and its Scratch() engines; like them not thread-safe.
class ShapeCache {
 public:
  std::shared_ptr<const CollisionShape> Get(const std::shared_ptr<const Shape>& shape);
  // By codec.h's bytes; null when they are not a dynamic body's shape.
  std::shared_ptr<const CollisionShape> GetDynamic(std::string_view bytes);

 private:
  std::shared_ptr<const CollisionShape> Add(std::string bytes, const std::shared_ptr<const Shape>& shape);

  std::map<std::string, std::weak_ptr<const CollisionShape>, std::less<>> shapes_;
  size_t sweep_at_ = 64;  // forget unused shapes when the map has grown to this size
};

}  // namespace aureole::physics
