#include "server/transport/peer_service.h"

#include <absl/strings/str_cat.h>

#include "server/transport/link_limits.h"

namespace aureole {
namespace {

grpc::Status ToGrpc(const absl::Status& s) {
  return {static_cast<grpc::StatusCode>(s.code()), std::string(s.message())};
}

// The accepted kind of stream. Deletes itself when gRPC is done with it. Finished once: by the end of reading, or, when
// a write is in flight then, by that write.
class AcceptStream final : public grpc::ServerBidiReactor<v1::PeerMessage, v1::PeerMessage>, public LinkStream {
 public:
  AcceptStream(PeerService* service, grpc::CallbackServerContext* context) : service_(service), context_(context) {
    StartRead(&in_);
  }

  void StartWriting(const v1::PeerMessage* message) override { StartWrite(message); }
  void Cancel() override { context_->TryCancel(); }

  void OnReadDone(bool ok) override {
    absl::Status s = absl::UnavailableError("connection closed");
    if (ok) s = link() == nullptr ? service_->Attach(this, in_, &link_) : link()->Read(this, &in_);
    if (s.ok()) {
      StartRead(&in_);
      return;
    }
    verdict_ = ToGrpc(s);
    if (link() == nullptr || link()->End(this)) Finish(verdict_);
  }

  void OnWriteDone(bool ok) override {
    if (link()->Written(this, ok)) Finish(verdict_);
  }

  void OnDone() override {
    PeerLink* const link = this->link();
    if (link != nullptr) link->Gone(this, verdict_);
    delete this;
    if (link != nullptr) link->Released();
  }

 private:
  PeerLink* link() const { return link_.load(std::memory_order_acquire); }

  PeerService* const service_;
  grpc::CallbackServerContext* const context_;
  std::atomic<PeerLink*> link_ = nullptr;  // stored by the reads, before the link may write
  grpc::Status verdict_;
  v1::PeerMessage in_;
};

}  // namespace

grpc::ServerBidiReactor<v1::PeerMessage, v1::PeerMessage>* PeerService::Link(grpc::CallbackServerContext* context) {
  return new AcceptStream(this, context);
}

void PeerService::Serve(const LinkIdentity& identity, const std::vector<PeerLink*>& links) {
  const std::lock_guard lock(mutex_);
  identity_ = identity;
  for (PeerLink* link : links) links_[link->peer()] = link;
  serving_ = true;
}

void PeerService::Add(PeerLink* link) {
  const std::lock_guard lock(mutex_);
  links_[link->peer()] = link;
}

void PeerService::Remove(const PeerLink* link) {
  const std::lock_guard lock(mutex_);
  const auto it = links_.find(link->peer());
  if (it != links_.end() && it->second == link) links_.erase(it);
}

void PeerService::Stop() {
  const std::lock_guard lock(mutex_);
  serving_ = false;
  links_.clear();
}

int64_t PeerService::refused() const {
  const std::lock_guard lock(mutex_);
  return refused_;
}

absl::Status PeerService::Attach(LinkStream* stream, const v1::PeerMessage& first, std::atomic<PeerLink*>* link) {
  const std::lock_guard lock(mutex_);
  if (!serving_) return absl::UnavailableError("this server has no region at present");
  const absl::StatusOr<PeerLink*> found = Find(first);
  absl::Status s = found.status();
  if (s.ok()) {
    link->store(*found, std::memory_order_release);
    s = (*found)->Attach(stream, first.hello());
    if (!s.ok()) link->store(nullptr, std::memory_order_release);
  }
  if (!s.ok() && !absl::IsUnavailable(s)) ++refused_;
  return s;
}

// Holds the mutex. What the two servers must agree on comes first: the caller's ids mean nothing without it. Since when
// the two are peers, the link knows.
absl::StatusOr<PeerLink*> PeerService::Find(const v1::PeerMessage& first) const {
  if (!first.has_hello()) return absl::InvalidArgumentError("the first message is no hello");
  LinkIdentity identity = identity_;
  identity.layout_epoch = first.hello().layout_epoch();
  if (absl::Status s = CheckHello(identity, first.hello()); !s.ok()) return s;
  const auto link = links_.find(first.hello().from());
  if (link != links_.end()) return link->second;
  return absl::FailedPreconditionError(absl::StrCat("link refused by region ", identity_.self, ": region ",
                                                    first.hello().from(), " does not dial this region"));
}

void ConfigureServer(grpc::ServerBuilder* builder) {
  builder->SetMaxReceiveMessageSize(kMaxMessageBytes);
  // Only health and reflection are synchronous services; one thread serves both.
  builder->SetSyncServerOption(grpc::ServerBuilder::NUM_CQS, 1);
  builder->SetSyncServerOption(grpc::ServerBuilder::MIN_POLLERS, 1);
  builder->SetSyncServerOption(grpc::ServerBuilder::MAX_POLLERS, 1);
  builder->AddChannelArgument(GRPC_ARG_KEEPALIVE_TIME_MS, kKeepaliveSeconds * 1000);
  builder->AddChannelArgument(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, kKeepaliveTimeoutSeconds * 1000);
  builder->AddChannelArgument(GRPC_ARG_HTTP2_MIN_RECV_PING_INTERVAL_WITHOUT_DATA_MS, kKeepaliveSeconds * 1000 / 2);
}

}  // namespace aureole
