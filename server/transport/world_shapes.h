// Shapes, materials and masses of a WorldSpec. For the loader in world_spec.cc.
#pragma once

#include <map>
#include <memory>
#include <string>

#include "server/core/scene.h"
#include "server/transport/spec_check.h"

namespace aureole {

// m^3; > 0. Overlapping children of a compound count twice. 0 for a plane, a mesh, a heightfield.
double Volume(const Shape& shape);

// The named shapes and materials of one world, and what is written in place.
class Catalogue {
 public:
  // Reads the spec's `shapes` and `materials`. `check` outlives the catalogue.
  Catalogue(const v1::WorldSpec& spec, SpecCheck* check);

  // The same names, for what is told to another `check`. What it reads itself it forgets with itself.
  Catalogue(const Catalogue& names, SpecCheck* check);

  // For a body that moves freely or by a script: planes, meshes and heightfields are refused. Never null.
  std::shared_ptr<const Shape> Moving(const Path& path, const v1::Shape& spec) const;
  // Any kind. Never null.
  std::shared_ptr<const Shape> Any(const Path& path, const v1::Shape& spec) const;
  // By name; "" is "default", or the core's own values where the world defines no such material.
  Material MaterialOf(const Path& path, const std::string& name) const;

  // kg, from the `mass` or the `density` that `spec` gives, or density 1000 kg/m^3.
  template <class Spec>
  double Mass(const Path& path, const Spec& spec, const std::shared_ptr<const Shape>& shape) {
    if (spec.has_mass()) return check_->In(limits::kMass, path / "mass", spec.mass());
    const double density =
        spec.has_density() ? check_->In(limits::kDensity, path / "density", spec.density()) : kDefaultDensity;
    return check_->In(limits::kMass, path / (spec.has_density() ? "density" : "shape"), density * CachedVolume(shape));
  }

 private:
  static constexpr double kDefaultDensity = 1000;  // kg/m^3, water

  std::shared_ptr<const Shape> Make(const Path& path, const v1::Shape& spec, bool child) const;
  void MakeHull(const Path& path, const v1::Shape::Hull& spec, Shape* out) const;
  void MakeCompound(const Path& path, const v1::Shape::Compound& spec, Shape* out) const;
  void MakeMesh(const Path& path, const v1::Shape::Mesh& spec, Shape* out) const;
  void MakeHeightfield(const Path& path, const v1::Shape::Heightfield& spec, Shape* out) const;

  double CachedVolume(const std::shared_ptr<const Shape>& shape);

  SpecCheck* check_;
  std::shared_ptr<const std::map<std::string, std::shared_ptr<const Shape>>> shapes_;
  std::shared_ptr<const std::map<std::string, Material>> materials_;
  std::map<std::shared_ptr<const Shape>, double> volumes_;  // a hull's is slow to find
};

}  // namespace aureole
