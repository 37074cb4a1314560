#include "server/transport/input_service.h"

#include <algorithm>
#include <string>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/transport/error_status.h"

namespace aureole {
namespace {

constexpr size_t kMostAllowances = 1 << 16;  // of clients, kept between their calls
constexpr size_t kMostGreatest = 1 << 17;

grpc::Status TooMany(double rate) {
  return Refusal(
      grpc::StatusCode::RESOURCE_EXHAUSTED, v1::RATE_LIMIT, "",
      absl::StrCat("the world allows a client ", rate,
                   " inputs per second, and the server has room for some of all clients; send fewer, later"));
}

}  // namespace

v1::Reason ReasonOf(const InputOutcome& outcome) {
  if (outcome.applied()) return v1::REASON_UNSPECIFIED;
  if (outcome.full) return v1::WORLD_FULL;
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
    if (outcome.applied()) summary_->set_last_tick(std::max<int64_t>(summary_->last_tick(), outcome.tick));
    Continue();
  }

  void Reject(v1::Reason reason, uint64_t sequence) override {
    AddRejected(reason, sequence, summary_->mutable_rejected());
  }

  void OnReadDone(bool ok) override {
    ImpulseInputs read;
    const std::shared_ptr<const InputScene> scene = service_->scene();
    if (ok && scene != nullptr) read = ReadBatch(*scene, (Path() / "batch")[batches_++], batch_, client_);
    const std::lock_guard lock(service_->mutex_);
    reading_ = false;
    if (ended_) return;
    if (ok) {
      if (service_->scene_ == nullptr) return End(RegionGivenUp());
      client_ = read.client;
      size_t taken = 0;
      const grpc::Status refusal = service_->Offer(this, std::move(read.inputs), &taken);
      waiting_ += taken;
      if (!refusal.ok()) return End(refusal);
      if (!read.refusal.ok()) return End(read.refusal);
    }
    all_read_ = !ok;
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
  uint64_t client_ = 0;  // of reads only
  int batches_ = 0;      // likewise
  size_t waiting_ = 0;   // outcomes
  bool reading_ = false, all_read_ = false;
};

// One call about bodies, each with a sequence of its own. As above.
class InputService::BodiesCall : public Call<grpc::ServerUnaryReactor> {
 public:
  using Call::Call;

  // `inputs`: one per body, with their sources, sequences growing by one; they have been allowed.
  void Offer(std::vector<Input> inputs) {
    if (!service_->HasRoom(static_cast<int64_t>(inputs.size()))) return End(TooMany(service_->scene_->limits.rate));
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
    if (outcome.applied()) response_->set_tick(std::max<int64_t>(response_->tick(), outcome.tick));
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
  return Start(new SpawnCall(this, request.sequence(), response), request, &ReadSpawns);
}

grpc::ServerUnaryReactor* InputService::RemoveBodies(const v1::RemoveBodiesRequest& request,
                                                     v1::RemoveBodiesResponse* response) {
  return Start(new RemoveCall(this, response), request, &ReadRemovals);
}

// Reads what a call is about in two steps, so that a client that sends too much costs little: how much it is, and what.
template <class Request>
grpc::ServerUnaryReactor* InputService::Start(BodiesCall* call, const Request& request, Reader<Request> read) {
  std::shared_ptr<const InputScene> scene;
  SpecCheck check;
  double cost = 0;
  {
    const std::lock_guard lock(mutex_);
    callers_.insert(call);
    scene = scene_;
    if (scene == nullptr) {
      call->End(NoRegion());
      return call;
    }
    cost = CostOf(request, &check);
    // A repetition, when its last input was taken before.
    const bool repeat = check.ok() && IsRepeat(request.client(), LastSequence(request));
    if (check.ok() && !Allow(request.client(), cost, repeat)) {
      call->End(TooMany(scene->limits.rate));
      return call;
    }
  }
  std::vector<Input> inputs;
  if (check.ok()) inputs = read(*scene, request, &check);
  const std::lock_guard lock(mutex_);
  if (!check.ok()) {
    call->End(Refusal(check));
  } else if (scene_ == nullptr) {
    call->End(RegionGivenUp());
  } else {
    call->Offer(std::move(inputs));
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
  const std::shared_ptr<const InputScene> now = scene();
  if (now == nullptr) return RegionGivenUp();
  ImpulseInputs read = ReadBatch(*now, path, batch, *client);
  *client = read.client;
  const std::lock_guard lock(mutex_);
  if (scene_ == nullptr) return RegionGivenUp();
  const grpc::Status refusal = Offer(caller, std::move(read.inputs), taken);
  return refusal.ok() ? read.refusal : refusal;
}

std::shared_ptr<const InputScene> InputService::scene() {
  const std::lock_guard lock(mutex_);
  return scene_;
}

// New ones over the limits are rejected, each for good. Of one that was taken before that cannot be said: it may have
// acted; then the whole call ends.
grpc::Status InputService::Offer(InputCaller* caller, std::vector<Input> inputs, size_t* taken) {
  for (Input& input : inputs) {
    if (!IsWithin(scene_->limits, input)) {
      caller->Reject(v1::TOO_STRONG, input.sequence);
      continue;
    }
    const bool repeat = IsRepeat(input.source, input.sequence);
    const double cost = static_cast<double>(CostOf(input)) * (repeat ? 1 : static_cast<double>(input.ticks));
    if (!HasRoom(CostOf(input)) || !Allow(input.source, cost, repeat)) {
      if (repeat) return TooMany(scene_->limits.rate);
      caller->Reject(v1::RATE_LIMIT, input.sequence);
      continue;
    }
    Submit(caller, std::move(input));
    ++*taken;
  }
  return grpc::Status::OK;
}

void InputService::Serve(const v1::WorldSpec& spec, int64_t tick_us) {
  const std::lock_guard lock(mutex_);
  scene_ = std::make_shared<const InputScene>(spec, tick_us);
}

void InputService::Stop() {
  const std::lock_guard lock(mutex_);
  for (InputCaller* c : callers_) c->End(RegionGivenUp());
  scene_.reset();
}

std::vector<Input> InputService::Take() {
  const std::lock_guard lock(mutex_);
  std::vector<Input> out;
  int cost = 0;
  while (!queue_.empty()) {
    Queued& next = queue_.front();
    cost += CostOf(next.input);
    if (cost > LiveInputs::kMostPerTick) break;
    queued_ -= CostOf(next.input);
    queued_bytes_ -= next.bytes;
    out.push_back(std::move(next.input));
    queue_.pop_front();
  }
  return out;
}

void InputService::Settle(const std::vector<InputOutcome>& outcomes) {
  const std::lock_guard lock(mutex_);
  for (const InputOutcome& o : outcomes) {
    const auto it = waiting_.find(o.name);
    if (it == waiting_.end()) continue;  // its call has ended
    InputCaller* caller = it->second;
    waiting_.erase(it);
    --caller->open_;
    caller->Settle(o);
  }
}

void InputService::Hear(const std::vector<Input>& delivered) {
  if (delivered.empty()) return;
  const std::lock_guard lock(mutex_);
  for (const Input& input : delivered) Note(input.source, input.sequence);
}

void InputService::Note(uint64_t client, uint64_t sequence) {
  if (greatest_.size() >= kMostGreatest && !greatest_.contains(client)) greatest_.clear();
  uint64_t& greatest = greatest_[client];
  greatest = std::max(greatest, sequence);
}

bool InputService::IsRepeat(uint64_t client, uint64_t sequence) const {
  const auto it = greatest_.find(client);
  return it != greatest_.end() && sequence <= it->second;
}

// Repetitions have an allowance of their own: refused for what is new, they might have acted all the same.
bool InputService::Allow(uint64_t client, double inputs, bool repeat) {
  const double rate = scene_->limits.rate;
  const Clock::time_point now = Clock::now();
  if (allowances_.size() >= kMostAllowances && !allowances_.contains(client)) {
    if (now - purged_at_ < std::chrono::seconds(1)) return false;
    purged_at_ = now;
    // Those of clients that were silent for a second are full again, as are those of new ones.
    absl::erase_if(allowances_, [now](const auto& e) { return now - e.second.at > std::chrono::seconds(1); });
  }
  const auto [it, fresh] = allowances_.try_emplace(client, Allowance{rate, rate, now});
  Allowance& a = it->second;
  const double more = rate * std::chrono::duration<double>(now - a.at).count();
  a.left = std::min(rate, a.left + more);
  a.repeats = std::min(rate, a.repeats + more);
  a.at = now;
  double& left = repeat ? a.repeats : a.left;
  // A force of many ticks may take more than a second's; then it takes all of it.
  if (left < std::min(inputs, rate)) return false;
  left -= std::min(inputs, rate);
  return true;
}

bool InputService::HasRoom(int64_t cost) const {
  return queued_ + cost <= kMostQueued && queued_bytes_ <= kMostQueuedBytes;
}

void InputService::Submit(InputCaller* caller, Input input) {
  waiting_.emplace(InputName{input.source, input.sequence}, caller);
  ++caller->open_;
  Note(input.source, input.sequence);
  const auto bytes = static_cast<int64_t>(BytesOf(input, queue_.empty() ? nullptr : &queue_.back().input));
  queued_ += CostOf(input);
  queued_bytes_ += bytes;
  queue_.push_back({std::move(input), bytes});
}

void InputService::Remove(InputCaller* caller) {
  callers_.erase(caller);
  if (caller->open_ > 0) std::erase_if(waiting_, [caller](const auto& e) { return e.second == caller; });
}

}  // namespace aureole
