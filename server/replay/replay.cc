#include "server/replay/replay.h"

#include <utility>

#include <absl/strings/str_cat.h>
#include <google/protobuf/util/message_differencer.h>

#include "server/physics/bullet_engine.h"
#include "server/transport/input_codec.h"
#include "server/transport/world_spec.h"

namespace aureole {

void ExpandShapes(google::protobuf::RepeatedPtrField<v1::Input>* inputs) {
  const v1::SolidShape* last = nullptr;
  for (v1::Input& input : *inputs) {
    if (!input.has_spawn()) continue;
    if (!input.spawn().has_shape() && last != nullptr) *input.mutable_spawn()->mutable_shape() = *last;
    last = &input.spawn().shape();
  }
}

absl::StatusOr<std::unique_ptr<Replay>> Replay::Begin(const std::vector<v1::Snapshot>& snapshots) {
  if (snapshots.empty()) return absl::InvalidArgumentError("the recording has no snapshot");
  const v1::Snapshot& first = snapshots[0];
  absl::StatusOr<World> loaded = WorldFromSpec(first.world());
  if (!loaded.ok()) return loaded.status();
  std::vector<std::string> states;
  for (const v1::Snapshot& s : snapshots) {
    if (s.tick() != first.tick()) {
      return absl::InvalidArgumentError(absl::StrCat("the snapshot of region ", s.region(), " is of tick ", s.tick(),
                                                     ", that of region ", first.region(), " of tick ", first.tick()));
    }
    if (!google::protobuf::util::MessageDifferencer::Equals(s.world(), first.world())) {
      return absl::InvalidArgumentError(absl::StrCat("the snapshot of region ", s.region(), " is of another world"));
    }
    states.push_back(s.state());
  }
  auto world = std::make_unique<World>(*std::move(loaded));
  absl::StatusOr<Undivided> run = Undivided::Resume(*world, MakeBulletEngine(world->environment), first.tick(), states);
  if (!run.ok()) return run.status();
  std::unique_ptr<Replay> out(new Replay(std::move(world), *std::move(run)));
  google::protobuf::RepeatedPtrField<v1::Input> to_come = first.to_come();
  ExpandShapes(&to_come);
  for (const v1::Input& input : to_come) {
    if (absl::Status s = out->Add(input); !s.ok()) return s;
  }
  return out;
}

absl::Status Replay::Add(const v1::Input& input) {
  Input read;
  if (absl::Status s = ReadRecordedInput(input, &read); !s.ok()) return s;
  if (read.tick + read.ticks - 1 <= tick()) {
    return absl::InvalidArgumentError(absl::StrCat("input ", read.sequence, " of client ", read.source,
                                                   " acts at tick ", read.tick, ", which is over"));
  }
  if (read.kind == Input::Kind::kSpawn && (run_.engine().Contains(read.body) || !spawned_.insert(read.body).second)) {
    return absl::InvalidArgumentError(absl::StrCat("input ", read.sequence, " of client ", read.source, " spawns body ",
                                                   read.body, ", which is there already"));
  }
  run_.Add(read);
  return absl::OkStatus();
}

std::optional<Replay::Difference> Replay::Compare(const std::map<BodyId, uint64_t>& recorded) const {
  const Engine& engine = run_.engine();
  const std::vector<BodyId> ids = engine.Ids();
  auto id = ids.begin();
  auto told = recorded.begin();
  while (id != ids.end() || told != recorded.end()) {
    if (told == recorded.end() || (id != ids.end() && *id < told->first)) return Difference{*id, 0, engine.Hash(*id)};
    if (id == ids.end() || told->first < *id) return Difference{told->first, told->second, 0};
    if (engine.Hash(*id) != told->second) return Difference{*id, told->second, engine.Hash(*id)};
    ++id;
    ++told;
  }
  return std::nullopt;
}

}  // namespace aureole
