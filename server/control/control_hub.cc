#include "server/control/control_hub.h"

#include <vector>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_join.h>

#include "server/control/control_plane_service.h"
#include "server/control/control_service.h"
#include "server/transport/error_status.h"

namespace aureole {
namespace {

class RefusedJoin final : public grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion> {
 public:
  explicit RefusedJoin(const grpc::Status& status) { Finish(status); }
  void OnDone() override { delete this; }
};

class RefusedWatch final : public grpc::ServerWriteReactor<v1::ControlEvent> {
 public:
  explicit RefusedWatch(const grpc::Status& status) { Finish(status); }
  void OnDone() override { delete this; }
};

std::string WorldOf(const grpc::ServerContextBase& context) {
  const auto& metadata = context.client_metadata();
  const auto found = metadata.find(kWorldMetadata);
  return found == metadata.end() ? "" : std::string(found->second.data(), found->second.size());
}

}  // namespace

// A run is not removed while one of its calls begins; what goes on then, it ends itself.
class ControlHub::Operators final : public v1::ControlPlane::CallbackService {
 public:
  explicit Operators(ControlHub* hub) : hub_(hub) {}

  grpc::ServerUnaryReactor* GetWorld(grpc::CallbackServerContext* context, const v1::GetControlledWorldRequest* request,
                                     v1::ControlledWorld* response) override {
    return Pass(context, [&](auto* to) { return to->GetWorld(context, request, response); });
  }
  grpc::ServerWriteReactor<v1::ControlEvent>* WatchEvents(grpc::CallbackServerContext* context,
                                                          const v1::WatchEventsRequest* request) override {
    const std::lock_guard lock(hub_->mutex_);
    const Run* run = nullptr;
    if (const grpc::Status s = hub_->Find(*context, nullptr, &run); !s.ok()) return new RefusedWatch(s);
    return run->operators->WatchEvents(context, request);
  }
  grpc::ServerUnaryReactor* ResizeLayout(grpc::CallbackServerContext* context, const v1::ResizeLayoutRequest* request,
                                         v1::ResizeLayoutResponse* response) override {
    return Pass(context, [&](auto* to) { return to->ResizeLayout(context, request, response); });
  }
  grpc::ServerUnaryReactor* DrainRegion(grpc::CallbackServerContext* context, const v1::DrainRegionRequest* request,
                                        v1::DrainRegionResponse* response) override {
    return Pass(context, [&](auto* to) { return to->DrainRegion(context, request, response); });
  }
  grpc::ServerUnaryReactor* SaveCheckpoint(grpc::CallbackServerContext* context,
                                           const v1::SaveCheckpointRequest* request,
                                           v1::SaveCheckpointResponse* response) override {
    return Pass(context, [&](auto* to) { return to->SaveCheckpoint(context, request, response); });
  }

 private:
  template <class Call>
  grpc::ServerUnaryReactor* Pass(grpc::CallbackServerContext* context, Call call) {
    const std::lock_guard lock(hub_->mutex_);
    const Run* run = nullptr;
    const grpc::Status s = hub_->Find(*context, nullptr, &run);
    if (s.ok()) return call(run->operators);
    grpc::ServerUnaryReactor* reactor = context->DefaultReactor();
    reactor->Finish(s);
    return reactor;
  }

  ControlHub* const hub_;
};

ControlHub::ControlHub() : operators_(std::make_unique<Operators>(this)) {}
ControlHub::~ControlHub() = default;

v1::ControlPlane::CallbackService& ControlHub::operators() { return *operators_; }

void ControlHub::Add(const std::string& world, const Run& run) {
  const std::lock_guard lock(mutex_);
  worlds_[world] = run;
}

void ControlHub::Remove(const std::string& world) {
  const std::lock_guard lock(mutex_);
  worlds_.erase(world);
}

grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion>* ControlHub::Join(grpc::CallbackServerContext* context) {
  const std::string world = WorldOf(*context);
  const std::lock_guard lock(mutex_);
  const auto run = worlds_.find(world);
  if (run != worlds_.end()) return run->second.servers->Join(context);
  return new RefusedJoin({grpc::StatusCode::UNAVAILABLE,
                          absl::StrCat(kWorldMetadata, ": no world '", world, "' runs here now; come again")});
}

grpc::Status ControlHub::TokensFor(const grpc::ServerContextBase& context, const std::string& known,
                                   std::string* world) {
  const std::lock_guard lock(mutex_);
  const Run* run = nullptr;
  grpc::Status s = Find(context, &known, &run);
  if (s.ok()) *world = run->tokens_for;
  return s;
}

grpc::Status ControlHub::Find(const grpc::ServerContextBase& context, const std::string* known, const Run** run) const {
  const std::string world = WorldOf(context);
  std::vector<std::string> names;
  for (const auto& [name, candidate] : worlds_) {
    if (candidate.operators == nullptr) continue;
    if (name == world) {
      *run = &candidate;
      return grpc::Status::OK;
    }
    if (known == nullptr || *known == candidate.tokens_for) names.push_back(name);
  }
  const std::string there =
      names.empty() ? "none runs here now" : absl::StrCat("here run: ", absl::StrJoin(names, ", "));
  if (world.empty()) {
    return Refusal(grpc::StatusCode::INVALID_ARGUMENT, v1::MISSING, kWorldMetadata,
                   absl::StrCat("must be in the metadata, and name a world; ", there));
  }
  return Refusal(grpc::StatusCode::NOT_FOUND, v1::NO_SUCH_WORLD, kWorldMetadata,
                 absl::StrCat("must name a world that runs here, is '", world, "'; ", there));
}

}  // namespace aureole
