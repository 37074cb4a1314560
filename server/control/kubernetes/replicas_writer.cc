#include "server/control/kubernetes/replicas_writer.h"

#include <utility>

#include "server/control/kubernetes/world_resource.h"

namespace aureole::kubernetes {

ReplicasWriter::ReplicasWriter(ApiClient* client, std::string space, std::string name, std::chrono::milliseconds again)
    : client_(client), space_(std::move(space)), name_(std::move(name)), again_(again) {}

absl::Status ReplicasWriter::Look(const Json& world, int replicas) {
  const int64_t generation = IntegerAt(world, {"metadata", "generation"}).value_or(0);
  if (Find(world, {"spec", "replicas"}) != nullptr || generation == written_ || Clock::now() < next_try_) {
    return absl::OkStatus();
  }
  const std::chrono::milliseconds at_most(2000);
  const absl::Status s =
      client_
          ->Patch(WorldsOf(space_).Sub("scale"), name_, {.body = {{"spec", {{"replicas", replicas}}}}},
                  {.timeout = at_most, .attempt_timeout = at_most, .attempts = 1})
          .status();
  if (s.ok()) written_ = generation;
  next_try_ = Clock::now() + again_;
  return absl::IsNotFound(s) ? absl::OkStatus() : s;  // the World has been deleted
}

}  // namespace aureole::kubernetes
