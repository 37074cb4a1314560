#include "server/control/control_hub.h"

#include <absl/strings/str_cat.h>

#include "server/control/control_service.h"

namespace aureole {
namespace {

class Refusal final : public grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion> {
 public:
  explicit Refusal(const grpc::Status& status) { Finish(status); }
  void OnDone() override { delete this; }
};

}  // namespace

void ControlHub::Add(const std::string& world, ControlService* service) {
  const std::lock_guard lock(mutex_);
  worlds_[world] = service;
}

void ControlHub::Remove(const std::string& world) {
  const std::lock_guard lock(mutex_);
  worlds_.erase(world);
}

grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion>* ControlHub::Join(grpc::CallbackServerContext* context) {
  const auto& metadata = context->client_metadata();
  const auto found = metadata.find(kWorldMetadata);
  const std::string world = found == metadata.end() ? "" : std::string(found->second.data(), found->second.size());
  const std::lock_guard lock(mutex_);
  const auto run = worlds_.find(world);
  if (run != worlds_.end()) return run->second->Join(context);
  return new Refusal({grpc::StatusCode::UNAVAILABLE,
                      absl::StrCat(kWorldMetadata, ": no world '", world, "' runs here now; come again")});
}

}  // namespace aureole
