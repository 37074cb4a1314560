#include "server/transport/impulse_service.h"

#include <algorithm>
#include <cmath>
#include <string>
#include <utility>

#include <absl/strings/str_cat.h>

namespace aureole {
namespace {

constexpr int kMaxBatch = 1024;
constexpr double kMaxImpulse = 1e9;  // N s, N m s

// Empty when it is fine.
std::string ReadVector(const v1::Vec3& in, const char* field, Vec3* out) {
  const double values[] = {in.x(), in.y(), in.z()};
  for (int i = 0; i < 3; ++i) {
    if (!std::isfinite(values[i]) || std::abs(values[i]) > kMaxImpulse) {
      return absl::StrCat(field, ".", std::string(1, "xyz"[i]), ": must be finite and at most 1e9 in magnitude");
    }
    (*out)[i] = values[i];
  }
  return "";
}

std::string ReadImpulse(const v1::Impulse& in, Input* out) {
  if (in.sequence() == 0) return "sequence: must be at least 1";
  if (in.body() == 0) return "body: must not be 0";
  if (!in.has_linear() && !in.has_angular()) return "linear: must be given, or angular";
  out->kind = Input::Kind::kImpulse;
  out->sequence = in.sequence();
  out->body = in.body();
  std::string wrong = ReadVector(in.linear(), "linear", &out->linear);
  return wrong.empty() ? ReadVector(in.angular(), "angular", &out->angular) : wrong;
}

}  // namespace

// One call. Its fields are guarded by the service's mutex; deletes itself.
class ImpulseService::Stream final : public grpc::ServerReadReactor<v1::ImpulseBatch> {
 public:
  Stream(ImpulseService* service, v1::ImpulseSummary* summary) : service_(service), summary_(summary) {}

  // Holds the mutex, as do all below but the reactions.
  void Read() {
    reading_ = true;
    StartRead(&batch_);
  }

  void End(const grpc::Status& status) {
    if (ended_) return;
    ended_ = true;
    Finish(status);
  }

  void Settle(const InputOutcome& outcome) {
    if (ended_) return;
    --waiting_;
    if (outcome.applied) {
      summary_->set_applied(summary_->applied() + 1);
    } else if (outcome.tick == 0) {
      summary_->set_forgotten(summary_->forgotten() + 1);
    } else {
      summary_->set_no_such_body(summary_->no_such_body() + 1);
    }
    summary_->set_last_tick(std::max<int64_t>(summary_->last_tick(), outcome.tick));
    Continue();
  }

  void OnReadDone(bool ok) override {
    const std::lock_guard lock(service_->mutex_);
    reading_ = false;
    if (ended_) return;
    if (!ok) {
      all_read_ = true;
    } else if (const std::string wrong = TakeBatch(); !wrong.empty()) {
      return End({grpc::StatusCode::INVALID_ARGUMENT, absl::StrCat("batch[", batches_, "].", wrong)});
    }
    ++batches_;
    Continue();
  }
  void OnCancel() override {
    const std::lock_guard lock(service_->mutex_);
    End(grpc::Status::CANCELLED);
  }
  void OnDone() override {
    {
      const std::lock_guard lock(service_->mutex_);
      service_->streams_.erase(this);
      std::erase_if(service_->waiting_, [this](const auto& e) { return e.second == this; });
    }
    delete this;
  }

 private:
  void Continue() {
    if (ended_ || reading_) return;
    if (!all_read_ && waiting_ < kMostWaiting) return Read();
    if (all_read_ && waiting_ == 0) End(grpc::Status::OK);
  }

  // What is wrong with it; then what came before that is taken.
  std::string TakeBatch() {
    if (client_ == 0) client_ = batch_.client();
    if (client_ == 0) return "client: must be given in the first batch, and not be 0";
    if (batch_.client() != 0 && batch_.client() != client_) return "client: must not change within a stream";
    if (batch_.impulse_size() > kMaxBatch) return "impulse: at most 1024 in a batch; send more batches";
    for (int i = 0; i < batch_.impulse_size(); ++i) {
      Input input;
      input.source = client_;
      const std::string wrong = ReadImpulse(batch_.impulse(i), &input);
      if (!wrong.empty()) return absl::StrCat("impulse[", i, "].", wrong);
      service_->waiting_.emplace(InputName{client_, input.sequence}, this);
      ++waiting_;
      service_->queue_.push_back(std::move(input));
    }
    return "";
  }

  ImpulseService* const service_;
  v1::ImpulseSummary* const summary_;
  v1::ImpulseBatch batch_;
  uint64_t client_ = 0;
  int64_t batches_ = 0;
  size_t waiting_ = 0;  // outcomes
  bool reading_ = false, all_read_ = false, ended_ = false;
};

grpc::ServerReadReactor<v1::ImpulseBatch>* ImpulseService::Apply(v1::ImpulseSummary* summary) {
  const std::lock_guard lock(mutex_);
  auto* stream = new Stream(this, summary);
  streams_.insert(stream);
  if (serving_) {
    stream->Read();
  } else {
    stream->End({grpc::StatusCode::UNAVAILABLE, "this server has no region at present"});
  }
  return stream;
}

void ImpulseService::Serve() {
  const std::lock_guard lock(mutex_);
  serving_ = true;
}

void ImpulseService::Stop() {
  const std::lock_guard lock(mutex_);
  serving_ = false;
  for (Stream* s : streams_) s->End({grpc::StatusCode::UNAVAILABLE, "this server gives up its region"});
}

std::vector<Input> ImpulseService::Take() {
  const std::lock_guard lock(mutex_);
  return std::exchange(queue_, {});
}

void ImpulseService::Settle(const std::vector<InputOutcome>& outcomes) {
  const std::lock_guard lock(mutex_);
  for (const InputOutcome& o : outcomes) {
    const auto it = waiting_.find(o.name);
    if (it == waiting_.end()) continue;  // its stream has ended
    Stream* stream = it->second;
    waiting_.erase(it);
    stream->Settle(o);
  }
}

}  // namespace aureole
