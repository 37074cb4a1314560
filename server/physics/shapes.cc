#include "server/physics/shapes.h"

#include <BulletCollision/CollisionShapes/btHeightfieldTerrainShape.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "server/physics/codec.h"

namespace aureole::physics {
namespace {

// Bullet keeps this skin around hulls, meshes and heightfields; its default of 4 cm would show as a gap.
constexpr double kSkin = 0.01;

std::unique_ptr<btCollisionShape> MakeConvex(const Shape& s) {
  switch (s.kind) {
    case ShapeKind::kSphere:
      return std::make_unique<btSphereShape>(s.radius);
    case ShapeKind::kBox:
      return std::make_unique<btBoxShape>(ToBullet(s.half));
    case ShapeKind::kCapsule:
      return std::make_unique<btCapsuleShape>(s.radius, 2 * (s.half.y() - s.radius));
    case ShapeKind::kCylinder:
      return std::make_unique<btCylinderShape>(btVector3(s.radius, s.half.y(), s.radius));
    case ShapeKind::kHull: {
      auto hull = std::make_unique<btConvexHullShape>();
      for (const Vec3& p : s.points) hull->addPoint(ToBullet(p), false);
      hull->setMargin(kSkin);
      hull->recalcLocalAabb();
      return hull;
    }
    default:
      return nullptr;
  }
}

std::unique_ptr<btStridingMeshInterface> MakeMesh(const Shape& s) {
  btIndexedMesh part;
  part.m_numTriangles = static_cast<int>(s.triangles.size() / 3);
  part.m_triangleIndexBase = reinterpret_cast<const unsigned char*>(s.triangles.data());
  part.m_triangleIndexStride = 3 * sizeof(uint32_t);
  part.m_numVertices = static_cast<int>(s.points.size());
  part.m_vertexBase = reinterpret_cast<const unsigned char*>(s.points.data());
  part.m_vertexStride = sizeof(Vec3);
  auto mesh = std::make_unique<btTriangleIndexVertexArray>();
  mesh->addIndexedMesh(part, PHY_INTEGER);
  return mesh;
}

// Bullet centres a heightfield between its extreme heights; symmetric extremes keep the origin at height 0.
std::unique_ptr<btCollisionShape> MakeHeightfield(const Shape& s) {
  double top = 1e-3;
  for (double h : s.heights) top = std::max(top, std::abs(h));
  auto field = std::make_unique<btHeightfieldTerrainShape>(s.columns, s.rows, s.heights.data(), -top, top, 1, false);
  field->setLocalScaling(btVector3(s.cell, 1, s.cell));
  field->setMargin(kSkin);
  return field;
}

}  // namespace

std::shared_ptr<const CollisionShape> ShapeCache::Get(const std::shared_ptr<const Shape>& shape) {
  std::string bytes = EncodeShape(*shape);
  if (auto it = shapes_.find(bytes); it != shapes_.end()) {
    if (auto found = it->second.lock()) return found;
  }
  return Add(std::move(bytes), shape);
}

std::shared_ptr<const CollisionShape> ShapeCache::GetDynamic(std::string_view bytes) {
  if (auto it = shapes_.find(bytes); it != shapes_.end()) {
    if (auto found = it->second.lock()) return found->kind <= ShapeKind::kCompound ? found : nullptr;
  }
  const std::shared_ptr<const Shape> shape = DecodeDynamicShape(bytes);
  return shape == nullptr ? nullptr : Add(std::string(bytes), shape);
}

std::shared_ptr<const CollisionShape> ShapeCache::Add(std::string bytes, const std::shared_ptr<const Shape>& shape) {
  auto made = std::make_shared<CollisionShape>();
  made->kind = shape->kind;
  made->bytes = std::move(bytes);
  made->source = shape;
  switch (shape->kind) {
    case ShapeKind::kCompound: {
      auto compound = std::make_unique<btCompoundShape>(false);
      for (const ChildShape& c : shape->children) {
        made->owned.push_back(MakeConvex(*c.shape));
        const btTransform local = ToBullet(c.orientation, c.position);
        compound->addChildShape(local, made->owned.back().get());
        made->parts.push_back({made->owned.back().get(), local});
      }
      made->owned.push_back(std::move(compound));
      break;
    }
    case ShapeKind::kPlane:
      made->owned.push_back(std::make_unique<btStaticPlaneShape>(ToBullet(shape->normal), shape->offset));
      break;
    case ShapeKind::kMesh:
      made->mesh = MakeMesh(*shape);
      made->owned.push_back(std::make_unique<btBvhTriangleMeshShape>(made->mesh.get(), true));
      made->owned.back()->setMargin(kSkin);
      break;
    case ShapeKind::kHeightfield:
      made->owned.push_back(MakeHeightfield(*shape));
      break;
    default:
      made->owned.push_back(MakeConvex(*shape));
  }
  made->whole = made->owned.back().get();
  if (made->parts.empty()) made->parts.push_back({made->whole});

  // Bullet turns the local box of every shape but the sphere, so the farthest corner of that box is the reach.
  btVector3 low, high;
  made->whole->getAabb(btTransform::getIdentity(), low, high);
  btVector3 corner = low.absolute();
  corner.setMax(high.absolute());
  made->reach = shape->kind == ShapeKind::kSphere ? shape->radius : corner.length() * (1 + 1e-12);
  made->smallest = 0.5 * (high - low)[(high - low).minAxis()];

  if (shapes_.size() >= sweep_at_) {
    std::erase_if(shapes_, [](const auto& entry) { return entry.second.expired(); });
    sweep_at_ = 2 * shapes_.size() + 64;
  }
  shapes_[made->bytes] = made;
  return made;
}

}  // namespace aureole::physics
