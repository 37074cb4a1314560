// Bodies of a WorldSpec: their ids, dynamic, kinematic and static ones. For the loader in world_spec.cc.
#pragma once

#include <vector>

#include <absl/container/flat_hash_map.h>

#include "server/core/scene.h"
#include "server/transport/world_shapes.h"

namespace aureole {

// The ids of a world. What is given in the file is claimed first; what has none then gets the next free one.
class BodyIds {
 public:
  explicit BodyIds(SpecCheck* check) : check_(check) {}
  // Claims first, ..., first + count - 1. first = 0: nothing is given.
  void Claim(const Path& path, BodyId first, int64_t count);
  // The id of copy number `copy` of what has the id `given`, or the next free one.
  BodyId For(BodyId given, int64_t copy);

 private:
  SpecCheck* check_;
  absl::flat_hash_map<BodyId, std::string> given_;  // to the path that claimed it
  BodyId next_ = 1;
};

// Everything the readers below need.
struct BodyReader {
  // Counts the bodies and claims the given ids.
  BodyReader(const v1::WorldSpec& s, SpecCheck* c);
  // With the same shapes and materials, for one message of a client.
  BodyReader(const BodyReader& names, SpecCheck* c) : check(c), catalogue(names.catalogue, c), ids(c) {}

  // Appends the body and its copies.
  void Dynamic(const Path& path, const v1::Body& from, std::vector<BodySpec>* out);
  void Kinematic(const Path& path, const v1::Mover& from, std::vector<BodySpec>* out);
  void Static(const Path& path, const v1::StaticBody& from, std::vector<BodySpec>* out);

  SpecCheck* check;
  Catalogue catalogue;
  BodyIds ids;
  int64_t bodies = 0;  // dynamic ones in the file, spawns of events included
};

}  // namespace aureole
