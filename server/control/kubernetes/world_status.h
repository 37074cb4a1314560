// What a World's status says, made of what the control plane knows. Pure functions.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "server/control/kubernetes/json.h"
#include "server/control/kubernetes/pod.h"
#include "server/control/kubernetes/world_resource.h"
#include "server/control/run_status.h"

namespace aureole::kubernetes {

struct Condition {
  std::string type;     // "Ready"
  bool holds = false;   // the status: True or False
  std::string reason;   // one word in CamelCase
  std::string message;  // for people; may be empty
};

struct WorldStatus {
  Json fields = Json::object();  // of status, at its top; null: there is none such any more
  std::vector<Condition> conditions;
  int64_t generation = 0;  // of the World that is meant
};

// Of a world that runs.
WorldStatus StatusOf(const WorldResource& world, const RunStatus& run, const std::map<RegionId, PodView>& pods);

// Of one that does not: `phase` is "Pending", "Draining", "Finished" or "Failed"; `reason` is of the condition Ready.
WorldStatus StoppedStatus(int64_t generation, const std::string& phase, const std::string& reason,
                          const std::string& message);

// Whether the World is as it runs; else what of it is not.
Condition Applied(const std::string& not_applied);

// The list of conditions after `before`: those that have not changed keep the time of their last transition, those
// that are not told of stay. `now`: RFC 3339.
Json ConditionList(const Json& before, const WorldStatus& status, const std::string& now);

}  // namespace aureole::kubernetes
