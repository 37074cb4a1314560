#include "server/transport/recording_service.h"

#include <algorithm>
#include <deque>
#include <string>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/transport/error_status.h"
#include "server/transport/input_codec.h"
#include "server/transport/message_stream.h"

namespace aureole {
namespace {

constexpr Tick kHashEvery = 16;

v1::StateHashes HashesOf(const Region& region) {
  v1::StateHashes out;
  out.set_tick(region.tick());
  out.set_region(region.self());
  out.set_layout_epoch(region.layout_epoch());
  BodyId last = 0;
  for (BodyId id : region.engine().Ids()) {
    out.add_body(id - std::exchange(last, id));
    out.add_hash(region.engine().Hash(id));
  }
  return out;
}

}  // namespace

// One call.
class RecordingService::Stream final : public MessageStream<v1::Recorded> {
 public:
  Stream(RecordingService* service, grpc::CallbackServerContext* context, const v1::RecordRequest& request)
      : MessageStream(&service->mutex_, context),
        service_(service),
        from_(request.from_tick()),
        hash_every_(request.hash_every() > 0 ? request.hash_every() : kHashEvery),
        inputs_(request.inputs()) {}

  Tick from() const { return from_; }
  bool WantsHashes(Tick n) const { return !ended() && n >= from_ && (n == from_ || n % hash_every_ == 0); }

  // A serialised Snapshot, which all streams of this tick share.
  void AddSnapshot(std::shared_ptr<const std::string> snapshot) {
    snapshot_ = std::move(snapshot);
    told_ = 0;
  }

  // Of a tick after from().
  void Add(Tick tick, const std::vector<Input>& delivered, const v1::StateHashes* hashes) {
    if (hashes == nullptr && (!inputs_ || delivered.empty())) return;
    v1::Recorded& next = queue_.emplace_back();
    next.set_tick(tick);
    if (inputs_) RecordInputs(delivered, next.mutable_inputs());
    if (hashes != nullptr) *next.mutable_hashes() = *hashes;
    waiting_bytes_ += next.ByteSizeLong();
    if (waiting_bytes_ > kMostWaiting) {
      queue_.clear();
      snapshot_ = nullptr;
      End(Refusal(grpc::StatusCode::RESOURCE_EXHAUSTED, v1::TOO_SLOW, "",
                  "the reader is 64 MiB behind; read faster, or ask for fewer hashes"));
    }
    Continue();
  }

 private:
  bool Next(v1::Recorded* out) override {
    if (snapshot_ != nullptr) {
      out->Clear();
      out->set_snapshot_part(snapshot_->substr(told_, kPartBytes));
      told_ += kPartBytes;
      if (told_ >= snapshot_->size()) {
        out->set_snapshot_complete(true);
        snapshot_ = nullptr;
      }
      return true;
    }
    if (queue_.empty()) return false;
    *out = std::move(queue_.front());
    queue_.pop_front();
    waiting_bytes_ -= out->ByteSizeLong();
    return true;
  }
  void Leave() override { service_->recorders_ -= static_cast<int>(service_->streams_.erase(this)); }

  RecordingService* const service_;
  const Tick from_, hash_every_;
  const bool inputs_;
  std::shared_ptr<const std::string> snapshot_;  // null: told
  size_t told_ = 0;                              // of its bytes
  std::deque<v1::Recorded> queue_;               // after it
  size_t waiting_bytes_ = 0;
};

grpc::ServerWriteReactor<v1::Recorded>* RecordingService::Record(grpc::CallbackServerContext* context,
                                                                 const v1::RecordRequest* request) {
  auto* stream = new Stream(this, context, *request);
  const std::lock_guard lock(mutex_);
  // In this order: the tick thread says that a tick is over, then looks who records.
  streams_.insert(stream);
  ++recorders_;
  if (!serving_) {
    stream->End(NoRegion());
  } else if (!synchronous_) {
    stream->End(Refusal(grpc::StatusCode::FAILED_PRECONDITION, v1::BAD_VALUE, "",
                        "the world's exchange must have no delay; bodies are always under way in one that has"));
  } else if (streams_.size() > kMostStreams) {
    stream->End(Refusal(grpc::StatusCode::RESOURCE_EXHAUSTED, v1::BUSY, "",
                        absl::StrCat("the server makes at most ", kMostStreams, " recordings at a time; try later")));
  } else if (request->from_tick() <= tick_) {
    stream->End(Refusal(grpc::StatusCode::OUT_OF_RANGE, v1::BAD_VALUE, "from_tick",
                        absl::StrCat("must be to come, and tick ", tick_.load(), " is over; ask for a later one")));
  } else if (request->hash_every() < 0) {
    stream->End(Refusal(grpc::StatusCode::INVALID_ARGUMENT, v1::BAD_VALUE, "hash_every", "must not be negative"));
  }
  return stream;
}

void RecordingService::Serve(RegionId region, const v1::WorldSpec& world, bool synchronous) {
  const std::lock_guard lock(mutex_);
  serving_ = true;
  region_ = region;
  world_ = world;
  synchronous_ = synchronous;
}

void RecordingService::Stop() {
  const std::lock_guard lock(mutex_);
  serving_ = false;
  for (Stream* s : streams_) s->End(RegionGivenUp());
}

void RecordingService::AfterTick(const Region& region, const std::vector<Input>& delivered) {
  const Tick n = region.tick();
  tick_ = n;
  if (recorders_ == 0) return;
  const std::lock_guard lock(mutex_);
  const auto any = [this](auto condition) { return std::any_of(streams_.begin(), streams_.end(), condition); };
  v1::StateHashes hashes;
  if (any([n](const Stream* s) { return s->WantsHashes(n); })) hashes = HashesOf(region);
  std::shared_ptr<const std::string> snapshot;
  if (any([n](const Stream* s) { return !s->ended() && s->from() == n; })) {
    v1::Snapshot taken;
    taken.set_region(region_);
    taken.set_tick(n);
    *taken.mutable_world() = world_;
    RegionSnapshot state = region.Snapshot();
    taken.set_state(std::move(state.state));
    RecordInputs(state.to_come, taken.mutable_to_come());
    snapshot = std::make_shared<const std::string>(taken.SerializeAsString());
  }
  for (Stream* s : streams_) {
    if (s->ended() || s->from() > n) continue;
    if (s->from() == n) s->AddSnapshot(snapshot);
    // What was delivered in that tick is to come in the snapshot.
    s->Add(n, s->from() == n ? std::vector<Input>() : delivered, s->WantsHashes(n) ? &hashes : nullptr);
  }
}

}  // namespace aureole
