// What a world may contain. Every limit has its unit and its reason; a message that refuses a value names the limit.
#pragma once

#include <cstdint>

#include "server/core/types.h"

namespace aureole::limits {

// Closed range of a quantity.
struct Range {
  double min, max;
  const char* unit;
};

// World coordinates. At the far end a double resolves 0.1 nm and a float32 aura box is widened by at most 6 cm.
inline constexpr Range kCoordinate{-1e6, 1e6, "m"};
// Of shapes. Below a millimetre the contact margins are larger than the body; above 100 km a box is a plane.
inline constexpr Range kSize{1e-3, 1e5, "m"};
// Ratios beyond these in one contact do not converge in an iterative solver anyway.
inline constexpr Range kMass{1e-6, 1e9, "kg"};
inline constexpr Range kDensity{1e-3, 1e5, "kg/m^3"};
// Ten times an orbital rail gun: anything faster is a ray, not a body (PITFALLS P21).
inline constexpr Range kSpeed{0, 1e4, "m/s"};
inline constexpr Range kSpeedTolerance{1e-3, 1e4, "m/s"};
inline constexpr Range kSpin{0, 1e3, "rad/s"};
inline constexpr Range kAcceleration{0, 1e3, "m/s^2"};
inline constexpr Range kImpulse{0, 1e12, "N s"};
inline constexpr Range kForce{0, 1e12, "N"};
inline constexpr Range kInputRate{1, 1e6, "inputs/s"};
inline constexpr Range kFriction{0, 10, ""};
inline constexpr Range kShare{0, 1, ""};  // restitution, damping
inline constexpr Range kWeight{0, 1e9, ""};
inline constexpr Range kReturnGap{0, 100, "m"};
inline constexpr Range kHomeSlack{0, 100, "m"};
// In thousandths of a body per second, so that spawn ticks are exact in integers.
inline constexpr Range kRate{1e-3, 1e5, "bodies/s"};
inline constexpr Range kDegrees{-360, 360, "degrees"};

// A tick shorter than 1 ms costs more in exchange than in physics; one longer than 100 ms tunnels at walking speed.
inline constexpr int64_t kMinTickUs = 1'000;
inline constexpr int64_t kMaxTickUs = 100'000;
// Of latency, frame time and skew: beyond a second nobody plays along.
inline constexpr int64_t kMaxToleranceUs = 1'000'000;
// Of scripts, events and injectors: 115 days.
inline constexpr int64_t kMaxTimeUs = 10'000'000'000'000;

// k. The margins were searched for counterexamples up to here (PROTOCOL.md section 9).
inline constexpr int kMaxDelay = 3;
inline constexpr int kMaxDwell = 10'000;  // ticks
// Every region sends its graph to all others (R16), which is fine for some tens of regions.
inline constexpr int kMaxRegions = 64;

// Bodies of one world at once and in its whole life, injected ones included: one float64 state takes about 1 kB.
inline constexpr int64_t kMaxBodies = 1'000'000;
inline constexpr int64_t kMaxFixed = 100'000;  // static and kinematic: every region holds all of them
inline constexpr int64_t kMaxJoints = 1'000'000;
inline constexpr int64_t kMaxEvents = 1'000'000;
inline constexpr int kMaxInjectors = 4096;
// Numbers up to here survive every JSON reader. Greater ids are given to injected and live bodies.
inline constexpr BodyId kMaxGivenId = (uint64_t{1} << 53) - 1;

// The hull of more points than that is slow in collision, and its facets are found by trying all triples.
inline constexpr int kMaxHullPoints = 64;
inline constexpr int kMaxChildren = 64;  // of a compound
inline constexpr int kMaxMeshPoints = 1'000'000;
inline constexpr int kMaxMeshTriangles = 1'000'000;
inline constexpr int kMaxHeights = 1'000'000;  // rows x columns
inline constexpr int kMaxScriptKeys = 10'000;
inline constexpr int kMaxIterations = 1'000;  // of the solver
inline constexpr int kMaxNameLength = 63;     // a DNS label, because Kubernetes objects carry it
inline constexpr int64_t kMaxWorldFileBytes = 64 << 20;

static_assert(kMaxGivenId < uint64_t{1} << 62, "injected bodies have bit 62 set");
static_assert(kMaxInjectors <= 1 << 14, "an injector's index has 14 bits in a body's id");
static_assert(kMaxBodies < int64_t{1} << 48, "an injected body's number has 48 bits in its id");
static_assert(kMaxTimeUs / 1'000'000 < int64_t{1} << 40, "elapsed microseconds times milli-rate fits in 128 bits");

}  // namespace aureole::limits
