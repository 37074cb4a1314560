#include "server/control/kubernetes/world_runner.h"

#include <algorithm>
#include <utility>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/strings/str_join.h>

#include "server/control/kubernetes/backoff.h"
#include "server/control/kubernetes/replicas_writer.h"
#include "server/control/kubernetes/world_scaler.h"
#include "server/control/layout_desk.h"
#include "server/control/scaling_run.h"
#include "server/transport/world_spec.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;

constexpr milliseconds kPublishEvery{500}, kLookEvery{100}, kReplicasAgain{5000};
// Of status: what cannot change of a run that has begun and not ended. For the next control plane.
constexpr char kAccepted[] = "accepted";

int64_t GenerationOf(const Json& object) { return IntegerAt(object, {"metadata", "generation"}).value_or(0); }

StatusStore::Options StoreOptions(const RunnerContext& context, const Json& object,
                                  std::function<void(const std::string&)> refused) {
  StatusStore::Options options = context.status;
  options.space = TextAt(object, {"metadata", "namespace"});
  options.name = TextAt(object, {"metadata", "name"});
  options.uid = TextAt(object, {"metadata", "uid"});
  options.epoch = context.epoch;
  options.leads = context.leads;
  options.refused = std::move(refused);
  return options;
}

// Which fields of the world that runs are otherwise in the World, in words.
std::string Differences(const WorldResource& runs, const WorldResource& wanted) {
  std::vector<std::string> fields;
  Json all = runs.fixed;
  all.update(wanted.fixed);
  for (const auto& [field, value] : all.items()) {
    if (runs.fixed.value(field, Json()) != wanted.fixed.value(field, Json())) fields.push_back("spec." + field);
  }
  if (runs.world_hash != wanted.world_hash) fields.push_back("spec.world");
  if (fields.empty()) return "";
  return absl::StrCat(absl::StrJoin(fields, ", "),
                      ": cannot change while the world runs; it goes on as it began. Change it back, or delete the "
                      "World and make it anew");
}

}  // namespace

WorldRunner::WorldRunner(const RunnerContext* context, Object world)
    : context_(context),
      space_(TextAt(*world, {"metadata", "namespace"})),
      name_(TextAt(*world, {"metadata", "name"})),
      uid_(TextAt(*world, {"metadata", "uid"})),
      store_(context->client, StoreOptions(*context, *world, [this](const std::string& why) { TellRefused(why); })),
      object_(std::move(world)),
      thread_([this] { Run(); }) {}

WorldRunner::~WorldRunner() = default;

void WorldRunner::Update(Object world) {
  {
    const std::lock_guard lock(mutex_);
    object_ = std::move(world);
  }
  changed_.notify_all();
}

void WorldRunner::Stop() {
  stopping_ = true;
  changed_.notify_all();
}

Object WorldRunner::Latest() const {
  const std::lock_guard lock(mutex_);
  return object_;
}

void WorldRunner::Tell(bool warning, const std::string& reason, const std::string& message) {
  context_->events->Record(
      {{absl::StrCat(kWorldGroup, "/", kWorldVersion), kWorldKind, space_, name_, uid_}, warning, reason, message});
}

void WorldRunner::TellRefused(const std::string& why) {
  Tell(true, "StatusRefused", why);
  context_->log(absl::StrCat("world ", name_, ": its status is refused: ", why));
}

void WorldRunner::Run() {
  Backoff backoff(context_->first_retry, context_->longest_retry);
  while (!ends()) {
    const Object object = Latest();
    const Next next = Try(*object);
    const auto changed = [&] { return ends() || GenerationOf(*object_) != GenerationOf(*object); };
    const Clock::time_point retry = next == Next::kOnChange ? Clock::time_point::max()
                                    : next == Next::kSoon   ? Clock::now() + kPublishEvery
                                                            : Clock::now() + backoff.Next();
    std::unique_lock lock(mutex_);
    // In short steps: nobody wakes us when the process leaves.
    while (!changed() && Clock::now() < retry) changed_.wait_for(lock, kLookEvery);
    if (changed()) backoff.Reset();
  }
  // Whoever reads of a World that is there still should read the end.
  if (!*context_->leave) store_.Flush(milliseconds(1000));
  store_.Close();
  done_ = true;
}

absl::StatusOr<std::optional<std::string>> WorldRunner::ReadSource(const Json& object) {
  const std::optional<WorldSource> source = SourceOf(object);
  if (!source) return std::nullopt;
  const absl::StatusOr<Json> map = context_->client->Get({"", "v1", "configmaps", space_}, source->config_map);
  if (absl::IsNotFound(map.status())) return std::nullopt;
  if (!map.ok()) return map.status();
  const Json* const text = Find(*map, {"data", source->key.c_str()});
  if (text == nullptr || !text->is_string()) return std::nullopt;
  return text->get<std::string>();
}

WorldRunner::Next WorldRunner::Refuse(int64_t generation, const std::string& phase, const std::string& reason,
                                      const std::string& message) {
  store_.Publish(StoppedStatus(generation, phase, reason, message));
  if (told_phase_ != message) Tell(true, reason, message);
  told_phase_ = message;
  return Next::kOnChange;
}

WorldRunner::Next WorldRunner::Try(const Json& object) {
  const int64_t generation = GenerationOf(object);
  const absl::StatusOr<std::optional<v1::WorldRecord>> record = store_.Load();
  if (absl::IsAborted(record.status())) return Next::kOnChange;  // it is gone, or another's
  if (absl::IsDataLoss(record.status())) {
    return Refuse(generation, "Failed", "RecordUnreadable", std::string(record.status().message()));
  }
  if (!record.ok()) return Next::kSoon;
  const Json status = store_.there();
  if (TextAt(status, {"phase"}) == "Finished") {  // for good, whatever changes
    PodTemplate pods;
    pods.world = name_;
    pods.space = space_;
    pods.uid = uid_;
    PodAllocator(context_->client, PodOptions(pods)).Kill();  // what the last control plane had no time for
    return Next::kOnChange;
  }
  const absl::StatusOr<std::optional<std::string>> file = ReadSource(object);
  if (!file.ok()) {
    Refuse(generation, "Pending", "SourceUnreadable", std::string(file.status().message()));
    return Next::kSoon;
  }
  // Of a run that an earlier control plane has begun.
  const Json* const accepted = Find(status, {kAccepted, "fixed"});
  defaults_ = context_->defaults;
  Pin(TextAt(status, {kAccepted, "image"}), TextAt(status, {kAccepted, "imagePullPolicy"}));
  const absl::StatusOr<WorldResource> world =
      ReadWorld(accepted != nullptr ? WithFixed(object, *accepted) : object, *file, defaults_);
  if (!world.ok()) {
    const Next next = Refuse(generation, accepted != nullptr ? "Failed" : "Pending", "Refused",
                             std::string(world.status().message()));
    return SourceOf(object) ? Next::kLater : next;
  }
  if (accepted == nullptr && record->has_value() &&
      absl::StrFormat("%016x", (*record)->world_hash()) != world->world_hash) {
    if (!store_.Forget().ok()) return Next::kSoon;
  }
  if (accepted != nullptr && TextAt(status, {kAccepted, "worldHash"}) != world->world_hash) {
    return Refuse(generation, "Failed", "CannotChange",
                  "spec.world: has changed while the world ran; change it back, or delete the World and make it anew");
  }
  if (accepted == nullptr) Pin(world->pods.image, world->pods.pull_policy);
  return RunOnce(*world);
}

void WorldRunner::Pin(const std::string& image, const std::string& pull_policy) {
  if (image.empty()) return;
  defaults_.image = image;
  defaults_.pull_policy = pull_policy;
}

PodAllocator::Options WorldRunner::PodOptions(const PodTemplate& pods) const {
  PodAllocator::Options options = context_->pods;
  options.pods = pods;
  options.leads = context_->leads;
  return options;
}

WorldRunner::Next WorldRunner::RunOnce(WorldResource world) {
  PodAllocator allocator(context_->client, PodOptions(world.pods));

  const absl::StatusOr<World> begins = WorldFromSpec(world.run.world);
  if (!begins.ok()) {
    return Refuse(world.generation, "Failed", "Refused", absl::StrCat("spec.world: ", begins.status().message()));
  }
  LayoutDesk desk(*begins);

  RunOptions run = world.run;
  run.layouts = &desk;
  run.events = &events_;
  run.hub = context_->hub;
  run.advertise = context_->advertise;
  run.store = &store_;
  run.control_epoch = static_cast<uint64_t>(context_->epoch);
  run.leave = context_->leave;
  run.join_timeout = context_->join_timeout;

  WorldStatus begun;
  begun.generation = world.generation;
  begun.fields = {{kAccepted, {{"fixed", world.fixed}, {"worldHash", world.world_hash}, {"image", defaults_.image}}}};
  if (!defaults_.pull_policy.empty()) begun.fields[kAccepted]["imagePullPolicy"] = defaults_.pull_policy;
  store_.Publish(begun);

  std::string not_applied;
  int64_t looked_at = 0;  // generation
  Clock::time_point next_publish;
  Stage stage = Stage::kJoining;
  const auto publish = [&](const RunStatus& now) {
    world.homes = desk.state().now.regions;
    world.pods.neighbours = Neighbours(world.homes);
    allocator.Use(world.pods);
    WorldStatus status = StatusOf(world, now, allocator.Newest());
    status.conditions.push_back(Applied(not_applied));
    const std::string phase = TextAt(status.fields, {"phase"});
    if (phase != told_phase_) Tell(false, phase, absl::StrCat(TextAt(status.fields, {"regionsReady"}), " regions"));
    told_phase_ = phase;
    store_.Publish(status);
  };
  ReplicasWriter replicas(context_->client, space_, name_, kReplicasAgain);
  WorldScaler scaler(
      context_->client, &desk, context_->leads,
      [this](bool warning, const std::string& reason, const std::string& message) { Tell(warning, reason, message); });
  const auto observe = [&](const RunStatus& now) {
    if (const Object latest = Latest(); GenerationOf(*latest) != looked_at) {
      looked_at = GenerationOf(*latest);
      not_applied = Change(*latest, &world);
      if (absl::Status s = desk.ResizeTo(world.replicas, world.scaling.on() ? WeightsOf(now) : std::vector<double>());
          !s.ok() && not_applied.empty()) {
        not_applied = absl::StrCat("spec.replicas: ", s.message());
      }
      allocator.Use(world.pods);
      if (!not_applied.empty()) Tell(true, "CannotChange", not_applied);
    }
    if (context_->leads() && !stopping_) {
      if (absl::Status s = replicas.Look(*Latest(), world.replicas); !s.ok()) {
        Tell(true, "CannotScale", absl::StrCat("spec.replicas: cannot be written: ", std::string(s.message())));
      }
      scaler.Look(world, now);
    }
    if (Clock::now() >= next_publish || now.stage != stage) {
      next_publish = Clock::now() + kPublishEvery;
      stage = now.stage;
      publish(now);
    }
    if (stopping_) store_.Publish(StoppedStatus(world.generation, "Draining", "Deleted", "its servers stop"));
    return !stopping_;
  };
  RunResult result;
  const absl::Status s = RunWorld(run, allocator, observe, &result, [this](const RunEvent& event) {
    Tell(IsWarning(event.kind), NameOf(event.kind), TextOf(event));
  });
  if (ends()) return Next::kOnChange;
  if (s.ok()) {
    publish(result.status);
    return Next::kOnChange;
  }
  // Its servers go on: the status could not be written or read. Whoever has the lease tries again.
  if (allocator.released()) return absl::IsInvalidArgument(s) ? Next::kLater : Next::kSoon;
  WorldStatus failed = StoppedStatus(world.generation, "Failed", "RunFailed", std::string(s.message()));
  failed.fields[kAccepted] = nullptr;
  store_.Publish(failed);
  Tell(true, "RunFailed", std::string(s.message()));
  told_phase_ = "Failed";
  return Next::kLater;
}

std::string WorldRunner::Change(const Json& object, WorldResource* world) {
  world->generation = GenerationOf(object);
  const absl::StatusOr<std::optional<std::string>> file = ReadSource(object);
  if (!file.ok()) return std::string(file.status().message());
  const absl::StatusOr<WorldResource> wanted = ReadWorld(object, *file, defaults_);
  if (!wanted.ok()) return std::string(wanted.status().message());
  const Storage storage = world->pods.storage;
  world->pods = wanted->pods;
  world->pods.storage = storage;
  world->replicas = wanted->replicas;
  world->replicas_given = wanted->replicas_given;
  world->scaling = wanted->scaling;
  return Differences(*world, *wanted);
}

}  // namespace aureole::kubernetes
