#include "server/transport/world_shapes.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/transport/convex_hull.h"

namespace aureole {
namespace {

constexpr double kPi = 3.14159265358979323846;

bool StaticOnly(ShapeKind kind) {
  return kind == ShapeKind::kPlane || kind == ShapeKind::kMesh || kind == ShapeKind::kHeightfield;
}

// A map in the order of its keys, so that the first mistake is the same in every run.
template <class Map>
auto Sorted(const Map& map) {
  return std::map<std::string, typename Map::mapped_type>(map.begin(), map.end());
}

std::shared_ptr<const Shape> Harmless() {
  Shape shape;
  shape.radius = 1;
  return std::make_shared<const Shape>(std::move(shape));
}

}  // namespace

double Volume(const Shape& s) {
  switch (s.kind) {
    case ShapeKind::kSphere:
      return 4.0 / 3.0 * kPi * s.radius * s.radius * s.radius;
    case ShapeKind::kBox:
      return 8 * s.half.x() * s.half.y() * s.half.z();
    case ShapeKind::kCapsule:  // a cylinder between two half spheres
      return kPi * s.radius * s.radius * (2 * (s.half.y() - s.radius) + 4.0 / 3.0 * s.radius);
    case ShapeKind::kCylinder:
      return 2 * kPi * s.radius * s.radius * s.half.y();
    case ShapeKind::kHull:
      return MeasureHull(s.points).volume;
    case ShapeKind::kCompound: {
      double sum = 0;
      for (const ChildShape& child : s.children) sum += Volume(*child.shape);
      return sum;
    }
    case ShapeKind::kPlane:
    case ShapeKind::kMesh:
    case ShapeKind::kHeightfield:
      return 0;
  }
  return 0;
}

Catalogue::Catalogue(const v1::WorldSpec& spec, SpecCheck* check) : check_(check) {
  std::map<std::string, Material> materials;
  for (const auto& [name, m] : Sorted(spec.materials())) {
    const Path path = (Path() / "materials")[name];
    Material out;
    if (m.has_friction()) out.friction = check->In(limits::kFriction, path / "friction", m.friction());
    out.rolling_friction = check->In(limits::kFriction, path / "rolling_friction", m.rolling_friction());
    out.spinning_friction = check->In(limits::kFriction, path / "spinning_friction", m.spinning_friction());
    out.restitution = check->In(limits::kShare, path / "restitution", m.restitution());
    out.linear_damping = check->In(limits::kShare, path / "linear_damping", m.linear_damping());
    if (m.has_angular_damping()) {
      out.angular_damping = check->In(limits::kShare, path / "angular_damping", m.angular_damping());
    }
    materials[name] = out;
  }
  materials_ = std::make_shared<const std::map<std::string, Material>>(std::move(materials));
  // A named shape that uses a name would need an order; it does not find any yet.
  std::map<std::string, std::shared_ptr<const Shape>> shapes;
  shapes_ = std::make_shared<const std::map<std::string, std::shared_ptr<const Shape>>>();
  for (const auto& [name, shape] : Sorted(spec.shapes())) {
    shapes[name] = Any((Path() / "shapes")[name], shape);
    CachedVolume(shapes[name]);
  }
  shapes_ = std::make_shared<const std::map<std::string, std::shared_ptr<const Shape>>>(std::move(shapes));
}

Catalogue::Catalogue(const Catalogue& names, SpecCheck* check)
    : check_(check), shapes_(names.shapes_), materials_(names.materials_), volumes_(names.volumes_) {}

double Catalogue::CachedVolume(const std::shared_ptr<const Shape>& shape) {
  const auto [it, inserted] = volumes_.try_emplace(shape, 0.0);
  if (inserted) it->second = Volume(*shape);
  return it->second;
}

Material Catalogue::MaterialOf(const Path& path, const std::string& name) const {
  const auto it = materials_->find(name.empty() ? "default" : name);
  if (it != materials_->end()) return it->second;
  if (!name.empty()) check_->Fail(path, absl::StrCat("there is no material \"", name, "\" in materials"));
  return {};
}

std::shared_ptr<const Shape> Catalogue::Any(const Path& path, const v1::Shape& spec) const {
  return Make(path, spec, false);
}

std::shared_ptr<const Shape> Catalogue::Moving(const Path& path, const v1::Shape& spec) const {
  std::shared_ptr<const Shape> shape = Make(path, spec, false);
  if (!StaticOnly(shape->kind)) return shape;
  check_->Fail(path, "must not be a plane, mesh or heightfield: only statics can be");
  return Harmless();
}

std::shared_ptr<const Shape> Catalogue::Make(const Path& path, const v1::Shape& spec, bool child) const {
  const auto radius = [&](const Path& p, double r) { return check_->In(limits::kSize, p / "radius", r); };
  const auto half_height = [&](const Path& p, double h) {
    return Vec3(0, check_->In(limits::kSize, p / "height", h) / 2, 0);
  };
  Shape out;
  switch (spec.kind_case()) {
    case v1::Shape::kNamed: {
      const auto it = shapes_->find(spec.named());
      if (it != shapes_->end()) return it->second;
      check_->Fail(path / "named",
                   absl::StrCat("there is no shape \"", spec.named(), "\" in shapes that could be used ",
                                "here; named shapes are written without names"));
      return Harmless();
    }
    case v1::Shape::kSphere:
      out.kind = ShapeKind::kSphere;
      out.radius = radius(path / "sphere", spec.sphere().radius());
      break;
    case v1::Shape::kBox: {
      out.kind = ShapeKind::kBox;
      const Path size = path / "box" / "size";
      out.half = {check_->In(limits::kSize, size / "x", spec.box().size().x()) / 2,
                  check_->In(limits::kSize, size / "y", spec.box().size().y()) / 2,
                  check_->In(limits::kSize, size / "z", spec.box().size().z()) / 2};
      break;
    }
    case v1::Shape::kCapsule: {
      const Path capsule = path / "capsule";
      out.kind = ShapeKind::kCapsule;
      out.radius = radius(capsule, spec.capsule().radius());
      out.half = half_height(capsule, spec.capsule().height());
      if (out.half.y() <= out.radius) {
        check_->Fail(capsule / "height", "must be more than 2 radius: it includes the caps; else use a sphere");
      }
      break;
    }
    case v1::Shape::kCylinder:
      out.kind = ShapeKind::kCylinder;
      out.radius = radius(path / "cylinder", spec.cylinder().radius());
      out.half = half_height(path / "cylinder", spec.cylinder().height());
      break;
    case v1::Shape::kHull:
      MakeHull(path / "hull", spec.hull(), &out);
      break;
    case v1::Shape::kCompound:
      if (child) check_->Fail(path / "compound", "must not be in a compound; list its children instead");
      if (!child) MakeCompound(path / "compound", spec.compound(), &out);
      break;
    case v1::Shape::kPlane:
      out.kind = ShapeKind::kPlane;
      out.normal = check_->Direction(path / "plane" / "normal", spec.plane().normal());
      out.offset = check_->In(limits::kCoordinate, path / "plane" / "offset", spec.plane().offset());
      break;
    case v1::Shape::kMesh:
      MakeMesh(path / "mesh", spec.mesh(), &out);
      break;
    case v1::Shape::kHeightfield:
      MakeHeightfield(path / "heightfield", spec.heightfield(), &out);
      break;
    case v1::Shape::KIND_NOT_SET:
      check_->Fail(path,
                   "must be given: sphere, box, capsule, cylinder, hull, compound, plane, mesh, heightfield or "
                   "named");
      return Harmless();
  }
  return std::make_shared<const Shape>(std::move(out));
}

void Catalogue::MakeHull(const Path& path, const v1::Shape::Hull& spec, Shape* out) const {
  out->kind = ShapeKind::kHull;
  const Path points = path / "points";
  if (spec.points_size() < 4 || spec.points_size() > limits::kMaxHullPoints) {
    return check_->Fail(points, absl::StrCat("must be 4 to ", limits::kMaxHullPoints, " points (is ",
                                             spec.points_size(), "); the limit is kMaxHullPoints"));
  }
  for (int i = 0; i < spec.points_size(); ++i) {
    out->points.push_back(check_->Vector({0, limits::kSize.max, "m"}, points[i], spec.points(i)));
  }
  if (!check_->ok()) return;
  const HullMeasure measure = MeasureHull(out->points);
  if (measure.volume <= 0) return check_->Fail(points, "must not all lie in one plane; use a box for a plate");
  if (measure.depth <= 0) {
    check_->Fail(points, "must have the origin inside: it is the body's centre of mass; shift the points");
  }
}

void Catalogue::MakeCompound(const Path& path, const v1::Shape::Compound& spec, Shape* out) const {
  out->kind = ShapeKind::kCompound;
  const Path children = path / "children";
  if (spec.children_size() < 1 || spec.children_size() > limits::kMaxChildren) {
    check_->Fail(children, absl::StrCat("must be 1 to ", limits::kMaxChildren, " shapes (is ", spec.children_size(),
                                        "); the limit is kMaxChildren"));
  }
  for (int i = 0; i < spec.children_size() && check_->ok(); ++i) {
    const v1::Shape::Child& from = spec.children(i);
    ChildShape child;
    child.position = check_->Vector({0, limits::kSize.max, "m"}, children[i] / "position", from.position());
    child.orientation = check_->Orientation(children[i], from);
    child.shape = Make(children[i] / "shape", from.shape(), true);
    if (StaticOnly(child.shape->kind) || child.shape->kind == ShapeKind::kCompound) {
      check_->Fail(children[i] / "shape", "must be a sphere, box, capsule, cylinder or hull");
    }
    out->children.push_back(std::move(child));
  }
}

void Catalogue::MakeMesh(const Path& path, const v1::Shape::Mesh& spec, Shape* out) const {
  out->kind = ShapeKind::kMesh;
  const Path points = path / "points", triangles = path / "triangles";
  if (spec.points_size() < 3 || spec.points_size() > limits::kMaxMeshPoints) {
    check_->Fail(points, absl::StrCat("must be 3 to ", limits::kMaxMeshPoints, " points (is ", spec.points_size(),
                                      "); the limit is kMaxMeshPoints"));
  }
  const int indices = spec.triangles_size();
  if (indices < 3 || indices % 3 != 0 || indices / 3 > limits::kMaxMeshTriangles) {
    check_->Fail(triangles, absl::StrCat("must be three indices for each of 1 to ", limits::kMaxMeshTriangles,
                                         " triangles (are ", indices, "); the limit is kMaxMeshTriangles"));
  }
  for (int i = 0; i < spec.points_size() && check_->ok(); ++i) {
    out->points.push_back(check_->Position(points[i], spec.points(i)));
  }
  for (int i = 0; i < indices && check_->ok(); ++i) {
    if (spec.triangles(i) < out->points.size()) {
      out->triangles.push_back(spec.triangles(i));
    } else {
      check_->Fail(triangles[i], absl::StrCat("must be the index of a point, less than ", out->points.size(), " (is ",
                                              spec.triangles(i), ")"));
    }
  }
  for (int i = 0; i < indices && check_->ok(); i += 3) {
    const Vec3 &a = out->points[out->triangles[i]], &b = out->points[out->triangles[i + 1]],
               &c = out->points[out->triangles[i + 2]];
    if ((b - a).cross(c - a).norm() < limits::kSize.min * limits::kSize.min) {
      check_->Fail(triangles[i], "begins a triangle without area; remove it");
    }
  }
}

void Catalogue::MakeHeightfield(const Path& path, const v1::Shape::Heightfield& spec, Shape* out) const {
  out->kind = ShapeKind::kHeightfield;
  out->rows = static_cast<int>(check_->Whole(path / "rows", spec.rows(), 2, limits::kMaxHeights / 2));
  out->columns = static_cast<int>(check_->Whole(path / "columns", spec.columns(), 2, limits::kMaxHeights / 2));
  out->cell = check_->In(limits::kSize, path / "cell", spec.cell());
  const int64_t wanted = int64_t{out->rows} * out->columns;
  if (wanted > limits::kMaxHeights) {
    check_->Fail(path / "columns", absl::StrCat("times rows must be at most kMaxHeights, ", limits::kMaxHeights));
  }
  if (spec.heights_size() != wanted) {
    check_->Fail(path / "heights",
                 absl::StrCat("must be rows x columns = ", wanted, " heights (are ", spec.heights_size(), ")"));
  }
  for (int i = 0; i < spec.heights_size() && check_->ok(); ++i) {
    const double h = spec.heights(i);
    if (!(std::abs(h) <= limits::kCoordinate.max)) check_->In(limits::kCoordinate, (path / "heights")[i], h);
    out->heights.push_back(h);
  }
}

}  // namespace aureole
