#include "server/transport/input_service.h"

#include <algorithm>
#include <string>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/transport/error_status.h"

namespace aureole {
namespace {

constexpr size_t kMostAllowances = 4096;  // of clients, kept between their calls

v1::WorldSpec NamesOf(const v1::WorldSpec& spec) {
  v1::WorldSpec out;
  *out.mutable_materials() = spec.materials();
  *out.mutable_shapes() = spec.shapes();
  return out;
}

int64_t Copies(const v1::Array& a) {
  const auto along = [](int64_t n) { return std::clamp<int64_t>(n, 1, InputService::kMostPerMessage + 1); };
  return along(a.x()) * along(a.y()) * along(a.z());
}

void CheckNames(uint64_t client, uint64_t sequence, int64_t inputs, SpecCheck* check) {
  if (client == 0) check->Fail(Path() / "client", "must be given, and not be 0", v1::MISSING);
  if (sequence == 0) check->Fail(Path() / "sequence", "must be at least 1", v1::MISSING);
  if (sequence > ~uint64_t{0} - static_cast<uint64_t>(inputs)) {
    check->Fail(Path() / "sequence", "must leave room for those of all bodies");
  }
}

}  // namespace

v1::Reason ReasonOf(const InputOutcome& outcome) {
  if (outcome.applied()) return v1::REASON_UNSPECIFIED;
  return outcome.tick == 0 ? v1::FORGOTTEN : v1::NO_SUCH_BODY;
}

void AddRejected(v1::Reason reason, uint64_t sequence, google::protobuf::RepeatedPtrField<v1::Rejected>* list) {
  auto it = std::find_if(list->begin(), list->end(), [reason](const v1::Rejected& r) { return r.reason() == reason; });
  if (it == list->end()) {
    v1::Rejected* added = list->Add();
    added->set_reason(reason);
    added->set_first_sequence(sequence);
    it = list->end() - 1;
  }
  it->set_count(it->count() + 1);
}

// What every call has. Its fields are guarded by the service's mutex; deletes itself.
template <class Reactor>
class InputService::Call : public Reactor, public InputCaller {
 public:
  explicit Call(InputService* service) : service_(service) {}

  void End(const grpc::Status& status) final {
    if (!std::exchange(ended_, true)) this->Finish(status);
  }
  void OnCancel() final {
    const std::lock_guard lock(service_->mutex_);
    End(grpc::Status::CANCELLED);
  }
  void OnDone() final {
    {
      const std::lock_guard lock(service_->mutex_);
      service_->Remove(this);
    }
    delete this;
  }

 protected:
  InputService* const service_;
  bool ended_ = false;
};

// One ApplyImpulses call.
class InputService::ImpulseStream final : public Call<grpc::ServerReadReactor<v1::ImpulseBatch>> {
 public:
  ImpulseStream(InputService* service, v1::ImpulseSummary* summary) : Call(service), summary_(summary) {}

  // Holds the mutex, as do all below but the reactions.
  void Read() {
    reading_ = true;
    StartRead(&batch_);
  }

  void Settle(const InputOutcome& outcome) override {
    if (ended_) return;
    --waiting_;
    if (outcome.applied()) {
      summary_->set_applied(summary_->applied() + 1);
      summary_->set_bodies(summary_->bodies() + outcome.bodies);
    } else {
      AddRejected(ReasonOf(outcome), outcome.name.second, summary_->mutable_rejected());
    }
    summary_->set_last_tick(std::max<int64_t>(summary_->last_tick(), outcome.tick));
    Continue();
  }

  void Reject(v1::Reason reason, uint64_t sequence) override {
    AddRejected(reason, sequence, summary_->mutable_rejected());
  }

  void OnReadDone(bool ok) override {
    const std::lock_guard lock(service_->mutex_);
    reading_ = false;
    if (ended_) return;
    if (!ok) {
      all_read_ = true;
    } else {
      size_t taken = 0;
      const grpc::Status refusal = service_->OfferLocked(this, (Path() / "batch")[batches_], batch_, &client_, &taken);
      waiting_ += taken;
      if (!refusal.ok()) return End(refusal);
    }
    ++batches_;
    Continue();
  }

 private:
  void Continue() {
    if (ended_ || reading_) return;
    if (!all_read_ && waiting_ < kMostWaiting) return Read();
    if (all_read_ && waiting_ == 0) End(grpc::Status::OK);
  }

  v1::ImpulseSummary* const summary_;
  v1::ImpulseBatch batch_;
  uint64_t client_ = 0;
  int batches_ = 0;
  size_t waiting_ = 0;  // outcomes
  bool reading_ = false, all_read_ = false;
};

// One call about bodies, each with a sequence of its own. As above.
class InputService::BodiesCall : public Call<grpc::ServerUnaryReactor> {
 public:
  using Call::Call;

  // `inputs`: one per body, with their sources, sequences growing by one.
  void Offer(std::vector<Input> inputs) {
    if (inputs.empty()) return End(grpc::Status::OK);
    if (!service_->Allow(inputs[0].source, static_cast<double>(inputs.size()))) {
      return End(Refusal(grpc::StatusCode::RESOURCE_EXHAUSTED, v1::RATE_LIMIT, "",
                         absl::StrCat("the world allows a client ", service_->scene_->limits.rate,
                                      " inputs per second; send fewer, later")));
    }
    waiting_ = inputs.size();
    for (Input& i : inputs) service_->Submit(this, std::move(i));
  }

  void Reject(v1::Reason, uint64_t) final {}  // all are refused together

  void Settle(const InputOutcome& outcome) final {
    if (ended_) return;
    Note(outcome);
    if (--waiting_ == 0) End(grpc::Status::OK);
  }

 private:
  virtual void Note(const InputOutcome& outcome) = 0;

  size_t waiting_ = 0;
};

class InputService::SpawnCall final : public BodiesCall {
 public:
  SpawnCall(InputService* service, uint64_t sequence, v1::SpawnBodiesResponse* response)
      : BodiesCall(service), first_(sequence), response_(response) {}

 private:
  void Note(const InputOutcome& outcome) override {
    const int place = static_cast<int>(outcome.name.second - first_);
    while (response_->body_size() <= place) response_->add_body(0);
    if (outcome.applied()) {
      response_->set_body(place, outcome.body);
    } else {
      AddRejected(ReasonOf(outcome), outcome.name.second, response_->mutable_rejected());
    }
    response_->set_tick(std::max<int64_t>(response_->tick(), outcome.tick));
  }

  const uint64_t first_;
  v1::SpawnBodiesResponse* const response_;
};

class InputService::RemoveCall final : public BodiesCall {
 public:
  RemoveCall(InputService* service, v1::RemoveBodiesResponse* response) : BodiesCall(service), response_(response) {}

 private:
  void Note(const InputOutcome& outcome) override {
    if (outcome.applied()) {
      response_->set_removed(response_->removed() + 1);
      response_->set_tick(std::max<int64_t>(response_->tick(), outcome.tick));
    } else {
      AddRejected(ReasonOf(outcome), outcome.name.second, response_->mutable_rejected());
    }
  }

  v1::RemoveBodiesResponse* const response_;
};

InputService::Scene::Scene(const v1::WorldSpec& spec, int64_t tick)
    : tick_us(tick),
      names(NamesOf(spec)),
      reader(names, &check),
      limits(ReadClientLimits(spec.client_limits(), &check)) {}

grpc::ServerReadReactor<v1::ImpulseBatch>* InputService::ApplyImpulses(v1::ImpulseSummary* summary) {
  const std::lock_guard lock(mutex_);
  auto* stream = new ImpulseStream(this, summary);
  callers_.insert(stream);
  if (scene_ != nullptr) {
    stream->Read();
  } else {
    stream->End(NoRegion());
  }
  return stream;
}

grpc::ServerUnaryReactor* InputService::SpawnBodies(const v1::SpawnBodiesRequest& request,
                                                    v1::SpawnBodiesResponse* response) {
  const std::lock_guard lock(mutex_);
  auto* call = new SpawnCall(this, request.sequence(), response);
  callers_.insert(call);
  if (scene_ == nullptr) {
    call->End(NoRegion());
    return call;
  }
  SpecCheck& check = scene_->check = SpecCheck();
  int64_t copies = 0;
  for (const v1::Body& b : request.bodies()) copies += Copies(b.array());
  CheckNames(request.client(), request.sequence(), copies, &check);
  const Path path = Path() / "bodies";
  if (request.bodies_size() == 0) check.Fail(path, "must be at least one", v1::MISSING);
  if (copies > kMostPerMessage)
    check.Fail(path, "must be at most 1024 with their copies; send more calls", v1::TOO_MANY);
  std::vector<BodySpec> bodies;
  for (int i = 0; i < request.bodies_size() && check.ok(); ++i) {
    if (request.bodies(i).id() != 0) {
      check.Fail(path[i] / "id", "must not be given: the servers give it, and the answer names it", v1::CONFLICT);
    }
    scene_->reader.Dynamic(path[i], request.bodies(i), &bodies);
  }
  if (!check.ok()) {
    call->End(Refusal(check));
    return call;
  }
  std::vector<Input> inputs(bodies.size());
  for (size_t i = 0; i < bodies.size(); ++i) {
    bodies[i].id = 0;
    inputs[i].kind = Input::Kind::kSpawn;
    inputs[i].source = request.client();
    inputs[i].sequence = request.sequence() + i;
    inputs[i].spawn = std::make_shared<const BodySpec>(std::move(bodies[i]));
  }
  call->Offer(std::move(inputs));
  return call;
}

grpc::ServerUnaryReactor* InputService::RemoveBodies(const v1::RemoveBodiesRequest& request,
                                                     v1::RemoveBodiesResponse* response) {
  const std::lock_guard lock(mutex_);
  auto* call = new RemoveCall(this, response);
  callers_.insert(call);
  if (scene_ == nullptr) {
    call->End(NoRegion());
    return call;
  }
  SpecCheck& check = scene_->check = SpecCheck();
  CheckNames(request.client(), request.sequence(), request.body_size(), &check);
  const Path path = Path() / "body";
  if (request.body_size() == 0) check.Fail(path, "must be at least one", v1::MISSING);
  if (request.body_size() > kMostPerMessage) check.Fail(path, "must be at most 1024; send more calls", v1::TOO_MANY);
  std::vector<Input> inputs(static_cast<size_t>(request.body_size()));
  for (int i = 0; i < request.body_size() && check.ok(); ++i) {
    if (request.body(i) == 0) check.Fail(path[i], "must not be 0");
    Input& input = inputs[static_cast<size_t>(i)];
    input.kind = Input::Kind::kRemove;
    input.source = request.client();
    input.sequence = request.sequence() + static_cast<uint64_t>(i);
    input.body = request.body(i);
  }
  if (check.ok()) {
    call->Offer(std::move(inputs));
  } else {
    call->End(Refusal(check));
  }
  return call;
}

bool InputService::Enter(InputCaller* caller) {
  const std::lock_guard lock(mutex_);
  if (scene_ == nullptr) return false;
  callers_.insert(caller);
  return true;
}

void InputService::Leave(InputCaller* caller) {
  const std::lock_guard lock(mutex_);
  Remove(caller);
}

grpc::Status InputService::Offer(InputCaller* caller, const Path& path, const v1::ImpulseBatch& batch, uint64_t* client,
                                 size_t* taken) {
  const std::lock_guard lock(mutex_);
  if (scene_ == nullptr) return RegionGivenUp();
  return OfferLocked(caller, path, batch, client, taken);
}

grpc::Status InputService::OfferLocked(InputCaller* caller, const Path& path, const v1::ImpulseBatch& batch,
                                       uint64_t* client, size_t* taken) {
  SpecCheck& check = scene_->check = SpecCheck();
  if (*client == 0) *client = batch.client();
  if (*client == 0) check.Fail(path / "client", "must be given in the first batch, and not be 0", v1::MISSING);
  if (batch.client() != 0 && batch.client() != *client) {
    check.Fail(path / "client", "must not change within a stream", v1::CONFLICT);
  }
  if (batch.impulse_size() > kMostPerMessage) {
    check.Fail(path / "impulse", "must be at most 1024 in a batch; send more batches", v1::TOO_MANY);
  }
  for (int i = 0; i < batch.impulse_size() && check.ok(); ++i) {
    Input input = ReadImpulse((path / "impulse")[i], batch.impulse(i), scene_->tick_us, &check);
    if (!check.ok()) break;
    input.source = *client;
    const bool within = IsWithin(scene_->limits, input);
    if (!within || !Allow(*client, static_cast<double>(input.ticks))) {
      caller->Reject(within ? v1::RATE_LIMIT : v1::TOO_STRONG, input.sequence);
      continue;
    }
    Submit(caller, std::move(input));
    ++*taken;
  }
  return check.ok() ? grpc::Status::OK : Refusal(check);
}

void InputService::Serve(const v1::WorldSpec& spec, int64_t tick_us) {
  const std::lock_guard lock(mutex_);
  scene_ = std::make_unique<Scene>(spec, tick_us);
}

void InputService::Stop() {
  const std::lock_guard lock(mutex_);
  for (InputCaller* c : callers_) c->End(RegionGivenUp());
  scene_.reset();
}

std::vector<Input> InputService::Take() {
  const std::lock_guard lock(mutex_);
  return std::exchange(queue_, {});
}

void InputService::Settle(const std::vector<InputOutcome>& outcomes) {
  const std::lock_guard lock(mutex_);
  for (const InputOutcome& o : outcomes) {
    const auto it = waiting_.find(o.name);
    if (it == waiting_.end()) continue;  // its call has ended
    InputCaller* caller = it->second;
    waiting_.erase(it);
    caller->Settle(o);
  }
}

bool InputService::Allow(uint64_t client, double inputs) {
  const double rate = scene_->limits.rate;
  const Clock::time_point now = Clock::now();
  if (allowances_.size() >= kMostAllowances && !allowances_.contains(client)) {
    // Those of clients that were silent for a second are full again, as are those of new ones.
    absl::erase_if(allowances_, [now](const auto& e) { return now - e.second.at > std::chrono::seconds(1); });
  }
  const auto [it, fresh] = allowances_.try_emplace(client, Allowance{rate, now});
  Allowance& a = it->second;
  a.left = std::min(rate, a.left + rate * std::chrono::duration<double>(now - a.at).count());
  a.at = now;
  // A force of many ticks may take more than a second's; then it takes all of it.
  if (a.left < std::min(inputs, rate)) return false;
  a.left -= std::min(inputs, rate);
  return true;
}

void InputService::Submit(InputCaller* caller, Input input) {
  waiting_.emplace(InputName{input.source, input.sequence}, caller);
  queue_.push_back(std::move(input));
}

void InputService::Remove(InputCaller* caller) {
  callers_.erase(caller);
  std::erase_if(waiting_, [caller](const auto& e) { return e.second == caller; });
}

}  // namespace aureole
