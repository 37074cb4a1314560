// Inputs of clients by the tick at which they act.
#pragma once

#include <map>
#include <vector>

#include "server/core/scene.h"

namespace aureole {

class InputSchedule {
 public:
  void Add(const Input& input);
  // What acts at tick n, appended, in no particular order; of a force, one impulse.
  void AppendDue(Tick n, std::vector<Input>* out) const;
  // What acts after tick n, as it was added, appended.
  void AppendAfter(Tick n, std::vector<Input>* out) const;
  // The spawn of this body at tick n; null when there is none.
  const Input* FindSpawn(Tick n, BodyId body) const;
  // Forgets what acted before tick n and acts no more.
  void ForgetBefore(Tick n);

  template <class Archive>
  void Visit(Archive& a) {
    a(due_, lasting_);
  }

 private:
  std::map<Tick, std::vector<Input>> due_;  // by the first tick
  std::vector<Input> lasting_;              // those of more than one
};

}  // namespace aureole
