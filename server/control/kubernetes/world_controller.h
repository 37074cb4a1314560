// All Worlds of a namespace, each with its runner, for as long as this control plane leads.
#pragma once

#include <map>
#include <memory>
#include <string>

#include "server/control/kubernetes/reflector.h"
#include "server/control/kubernetes/wakeup.h"
#include "server/control/kubernetes/world_runner.h"

namespace aureole::kubernetes {

// One thread.
class WorldController {
 public:
  // `context` and `wakeup`, which is notified when there is something to reconcile, must outlive it.
  WorldController(const RunnerContext* context, const std::string& space, Wakeup* wakeup);
  // Leaves.
  ~WorldController();
  WorldController(const WorldController&) = delete;
  WorldController& operator=(const WorldController&) = delete;

  // Starts, updates and stops runners. Call it when woken, and several times a second. Cheap when nothing changed.
  void Reconcile();
  // After context.leave has become true: returns when all runners have ended.
  void Leave();
  size_t worlds() const { return runners_.size(); }
  // Why the list of Worlds may be out of date.
  absl::Status health() const { return reflector_.health(); }

 private:
  const RunnerContext* const context_;
  Reflector reflector_;
  std::map<std::string, std::unique_ptr<WorldRunner>> runners_;  // by "namespace/name"
};

}  // namespace aureole::kubernetes
