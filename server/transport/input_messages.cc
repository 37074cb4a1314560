#include "server/transport/input_messages.h"

#include <algorithm>
#include <memory>
#include <utility>

#include "server/transport/error_status.h"

namespace aureole {
namespace {

constexpr const char* kReserved = "must not be 2^64 - 1, which is the control plane's; choose another number";

v1::WorldSpec NamesOf(const v1::WorldSpec& spec) {
  v1::WorldSpec out;
  *out.mutable_materials() = spec.materials();
  *out.mutable_shapes() = spec.shapes();
  return out;
}

int64_t Copies(const v1::Array& a) {
  const auto along = [](int64_t n) { return std::clamp<int64_t>(n, 1, kMostInputsPerMessage + 1); };
  return along(a.x()) * along(a.y()) * along(a.z());
}

int64_t HullPoints(const v1::Shape& shape) {
  int64_t points = shape.hull().points_size();
  for (const auto& child : shape.compound().children()) points += child.shape().hull().points_size();
  return points;
}

void CheckNames(uint64_t client, uint64_t sequence, int64_t inputs, SpecCheck* check) {
  if (client == 0) check->Fail(Path() / "client", "must be given, and not be 0", v1::MISSING);
  if (client == kControlSource) check->Fail(Path() / "client", kReserved);
  if (sequence == 0) check->Fail(Path() / "sequence", "must be at least 1", v1::MISSING);
  if (sequence > ~uint64_t{0} - static_cast<uint64_t>(inputs)) {
    check->Fail(Path() / "sequence", "must leave room for those of all bodies");
  }
}

}  // namespace

InputScene::InputScene(const v1::WorldSpec& spec, int64_t tick)
    : tick_us(tick),
      names(NamesOf(spec)),
      reader(names, &check),
      limits(ReadClientLimits(spec.client_limits(), &check)) {}

ImpulseInputs ReadBatch(const InputScene& scene, const Path& path, const v1::ImpulseBatch& batch, uint64_t client) {
  SpecCheck check;
  ImpulseInputs out;
  out.client = client == 0 ? batch.client() : client;
  if (out.client == 0) check.Fail(path / "client", "must be given in the first batch, and not be 0", v1::MISSING);
  if (out.client == kControlSource) check.Fail(path / "client", kReserved);
  if (batch.client() != 0 && batch.client() != out.client) {
    check.Fail(path / "client", "must not change within a stream", v1::CONFLICT);
  }
  if (batch.impulse_size() > kMostInputsPerMessage) {
    check.Fail(path / "impulse", "must be at most 1024 in a batch; send more batches", v1::TOO_MANY);
  }
  for (int i = 0; i < batch.impulse_size() && check.ok(); ++i) {
    Input input = ReadImpulse((path / "impulse")[i], batch.impulse(i), scene.tick_us, &check);
    input.source = out.client;
    if (check.ok()) out.inputs.push_back(std::move(input));
  }
  if (!check.ok()) out.refusal = Refusal(check);
  return out;
}

double CostOf(const v1::SpawnBodiesRequest& request, SpecCheck* check) {
  int64_t copies = 0, points = 0;
  for (const v1::Body& b : request.bodies()) {
    copies += Copies(b.array());
    points += HullPoints(b.shape());
  }
  CheckNames(request.client(), request.sequence(), copies, check);
  const Path path = Path() / "bodies";
  if (request.bodies_size() == 0) check->Fail(path, "must be at least one", v1::MISSING);
  if (copies > kMostInputsPerMessage) {
    check->Fail(path, "must be at most 1024 with their copies; send more calls", v1::TOO_MANY);
  }
  if (points > kMostHullPoints) {
    check->Fail(path, "must have at most 4096 points of hulls in all; name shapes in the world, or send more calls",
                v1::TOO_MANY);
  }
  return static_cast<double>(copies + points);
}

double CostOf(const v1::RemoveBodiesRequest& request, SpecCheck* check) {
  CheckNames(request.client(), request.sequence(), request.body_size(), check);
  const Path path = Path() / "body";
  if (request.body_size() == 0) check->Fail(path, "must be at least one", v1::MISSING);
  if (request.body_size() > kMostInputsPerMessage)
    check->Fail(path, "must be at most 1024; send more calls", v1::TOO_MANY);
  return request.body_size();
}

uint64_t LastSequence(const v1::SpawnBodiesRequest& request) {
  uint64_t copies = 0;
  for (const v1::Body& b : request.bodies()) copies += static_cast<uint64_t>(Copies(b.array()));
  return request.sequence() + copies - 1;
}

uint64_t LastSequence(const v1::RemoveBodiesRequest& request) {
  return request.sequence() + static_cast<uint64_t>(request.body_size()) - 1;
}

std::vector<Input> ReadSpawns(const InputScene& scene, const v1::SpawnBodiesRequest& request, SpecCheck* check) {
  BodyReader reader(scene.reader, check);
  std::vector<BodySpec> bodies;
  const Path path = Path() / "bodies";
  for (int i = 0; i < request.bodies_size() && check->ok(); ++i) {
    if (request.bodies(i).id() != 0) {
      check->Fail(path[i] / "id", "must not be given: the servers give it, and the answer names it", v1::CONFLICT);
    }
    reader.Dynamic(path[i], request.bodies(i), &bodies);
  }
  std::vector<Input> inputs(check->ok() ? bodies.size() : 0);
  for (size_t i = 0; i < inputs.size(); ++i) {
    bodies[i].id = 0;
    inputs[i].kind = Input::Kind::kSpawn;
    inputs[i].source = request.client();
    inputs[i].sequence = request.sequence() + i;
    inputs[i].spawn = std::make_shared<const BodySpec>(std::move(bodies[i]));
  }
  return inputs;
}

std::vector<Input> ReadRemovals(const InputScene&, const v1::RemoveBodiesRequest& request, SpecCheck* check) {
  std::vector<Input> inputs(static_cast<size_t>(request.body_size()));
  for (int i = 0; i < request.body_size() && check->ok(); ++i) {
    if (request.body(i) == 0) check->Fail((Path() / "body")[i], "must not be 0");
    Input& input = inputs[static_cast<size_t>(i)];
    input.kind = Input::Kind::kRemove;
    input.source = request.client();
    input.sequence = request.sequence() + static_cast<uint64_t>(i);
    input.body = request.body(i);
  }
  return inputs;
}

}  // namespace aureole
