// Vectors, shapes and materials as clients see them, in the terms of a world file.
#pragma once

#include "aureole/v1/simulation.pb.h"
#include "aureole/v1/world.pb.h"
#include "server/core/scene.h"

namespace aureole {

void SetVec3(const Vec3& v, v1::Vec3* out);
void SetQuat(const Quat& q, v1::Quaternion* out);
v1::Shape ShapeToProto(const Shape& shape);
v1::Material MaterialToProto(const Material& material);
// Of a static or kinematic body.
v1::FixedBody FixedToProto(const BodySpec& body);

}  // namespace aureole
