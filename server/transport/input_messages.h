// The messages of clients that bring inputs (proto/aureole/v1/simulation.proto), as the core's inputs.
// Thread-compatible; a mistake is told to `check`, or with the refusal of the call.
#pragma once

#include <cstdint>
#include <vector>

#include <grpcpp/support/status.h>

#include "aureole/v1/simulation.pb.h"
#include "server/core/scene.h"
#include "server/transport/input_reader.h"
#include "server/transport/world_bodies.h"

namespace aureole {

// Inputs in one message, copies of bodies included, and points of the hulls in it, which are slow to check.
inline constexpr int kMostInputsPerMessage = 1024, kMostHullPoints = 4096;

// What the messages of one world are read with.
struct InputScene {
  InputScene(const v1::WorldSpec& spec, int64_t tick);
  const int64_t tick_us;
  v1::WorldSpec names;  // the named shapes and materials only
  SpecCheck check;      // of these
  BodyReader reader;
  ClientLimits limits;
};

// What is in a batch up to the first mistake.
struct ImpulseInputs {
  uint64_t client = 0;
  std::vector<Input> inputs;
  grpc::Status refusal;
};
// `client`: of the batches before; 0: this is the first.
ImpulseInputs ReadBatch(const InputScene& scene, const Path& path, const v1::ImpulseBatch& batch, uint64_t client);

// How many inputs the message is worth. Checks what can be checked without reading bodies; cheap.
double CostOf(const v1::SpawnBodiesRequest& request, SpecCheck* check);
double CostOf(const v1::RemoveBodiesRequest& request, SpecCheck* check);
// After CostOf: the sequence of the last body.
uint64_t LastSequence(const v1::SpawnBodiesRequest& request);
uint64_t LastSequence(const v1::RemoveBodiesRequest& request);
// After CostOf. One input per body, sequences growing by one.
std::vector<Input> ReadSpawns(const InputScene& scene, const v1::SpawnBodiesRequest& request, SpecCheck* check);
std::vector<Input> ReadRemovals(const InputScene& scene, const v1::RemoveBodiesRequest& request, SpecCheck* check);

}  // namespace aureole
