#include "server/control/kubernetes/world_controller.h"

namespace aureole::kubernetes {

WorldController::WorldController(const RunnerContext* context, const std::string& space, Wakeup* wakeup)
    : context_(context),
      reflector_(context->client,
                 {.resource = WorldsOf(space),
                  .first_pause = context->pods.first_pause,
                  .longest_pause = context->pods.longest_pause},
                 wakeup) {}

WorldController::~WorldController() { Leave(); }

void WorldController::Reconcile() {
  if (!reflector_.synced()) return;
  const Objects worlds = reflector_.objects();
  const auto wanted = [&](const std::string& key) -> Object {
    const auto found = worlds.find(key);
    const bool there = found != worlds.end() && TextAt(*found->second, {"metadata", "deletionTimestamp"}).empty();
    return there ? found->second : nullptr;
  };
  for (auto it = runners_.begin(); it != runners_.end();) {
    const Object world = wanted(it->first);
    if (world != nullptr && TextAt(*world, {"metadata", "uid"}) == it->second->uid()) {
      it->second->Update(world);
    } else {
      it->second->Stop();
    }
    // A World of the same name that comes meanwhile waits for the end of the old one.
    it = it->second->done() ? runners_.erase(it) : std::next(it);
  }
  for (const auto& [key, object] : worlds) {
    if (wanted(key) != nullptr && !runners_.contains(key)) {
      runners_.emplace(key, std::make_unique<WorldRunner>(context_, object));
    }
  }
}

void WorldController::Leave() {
  for (const auto& [key, runner] : runners_) runner->Hurry();
  runners_.clear();
}

}  // namespace aureole::kubernetes
