#include "server/core/apply_input.h"

#include <vector>

namespace aureole {
namespace {

int64_t ApplyToArea(const Input& input, Engine* engine) {
  const Area& area = input.area;
  std::vector<BodyId> near;
  engine->Query({area.centre.array() - area.radius, area.centre.array() + area.radius}, &near);
  int64_t hit = 0;
  Input one = input;
  one.area = {};
  for (BodyId id : near) {
    const Vec3 out = engine->View(id).centre - area.centre;
    const double distance = out.norm();
    if (distance > area.radius) continue;
    one.body = id;
    one.linear = input.linear;
    if (distance > 0) {
      const double share = area.fades ? 1 - distance / area.radius : 1;
      one.linear += out * (area.outward * share / distance);
    }
    engine->Apply(one);
    ++hit;
  }
  return hit;
}

}  // namespace

int64_t ApplyInput(const Input& input, Engine* engine) {
  if (input.over_area()) return ApplyToArea(input, engine);
  if (input.kind != Input::Kind::kSpawn && !engine->Contains(input.body)) return 0;
  engine->Apply(input);
  return 1;
}

}  // namespace aureole
