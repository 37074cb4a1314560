// Stock btDiscreteDynamicsWorld with none of our rules: the baseline that the cost of exactness is measured against.
// Same shapes, materials, solver iterations, tick and inputs; not exact, cannot migrate.
#pragma once

#include <memory>
#include <vector>

#include "server/core/scene.h"

namespace aureole {

class PlainBulletWorld {
 public:
  explicit PlainBulletWorld(const Environment& environment);
  ~PlainBulletWorld();

  void Spawn(const BodySpec& body);
  void Step(Tick n);
  int64_t CountContacts() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace aureole
