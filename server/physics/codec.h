// Shapes, bodies' descriptions and joints as bytes, for the engine's state. Decoding refuses whatever the engine could
// not simulate (unknown kinds, sizes and numbers out of range), so decoded values need no further check.
#pragma once

#include <memory>
#include <string>
#include <string_view>

#include "server/core/scene.h"
#include "server/physics/bytes.h"

namespace aureole::physics {

// Largest magnitudes in a state: far above anything a world produces, low enough that no arithmetic overflows.
inline constexpr double kMaxPosition = 1e12;   // m
inline constexpr double kMaxVelocity = 1e9;    // m/s, rad/s
inline constexpr double kMaxExtent = 1e6;      // m, of a shape
inline constexpr double kMinExtent = 1e-4;     // m
inline constexpr double kMaxMass = 1e15;       // kg
inline constexpr double kMinMass = 1e-9;       // kg
inline constexpr double kMaxQuantity = 1e18;   // anything else: impulses, coefficients
inline constexpr uint32_t kMaxPoints = 65536;  // of one hull
inline constexpr uint32_t kMaxChildren = 4096;

void PutVec3(const Vec3& v, ByteWriter* out);
Vec3 GetVec3(double bound, ByteReader* in);

// Equal shapes give equal bytes.
std::string EncodeShape(const Shape& shape);
// A shape of a dynamic body, or null.
std::shared_ptr<const Shape> DecodeDynamicShape(std::string_view bytes);

void PutMaterial(const Material& m, ByteWriter* out);
Material GetMaterial(ByteReader* in);

void PutJoint(const JointSpec& j, ByteWriter* out);
JointSpec GetJoint(ByteReader* in);

}  // namespace aureole::physics
