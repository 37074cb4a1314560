#include "server/transport/peer_link.h"

#include <algorithm>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>

#include "server/core/check.h"
#include "server/transport/frame_codec.h"
#include "server/transport/link_limits.h"
#include "server/transport/peer_channel.h"

namespace aureole {
namespace {

// The dialled kind of stream. Deletes itself when gRPC is done with it.
//
// Writes start outside of gRPC's callbacks, so the call is held open until nothing is read any more. All that starts an
// operation holds the link's mutex; gRPC never calls back from within.
class DialStream final : public grpc::ClientBidiReactor<v1::PeerMessage, v1::PeerMessage>, public LinkStream {
 public:
  explicit DialStream(PeerLink* link) : link_(link) {}

  void Start(v1::Peer::Stub* stub) {
    stub->async()->Link(&context_, this);
    AddHold();
    StartRead(&in_);
    StartWrite(&out);
    StartCall();
  }

  void StartWriting(const v1::PeerMessage* message) override { StartWrite(message); }
  void Cancel() override { context_.TryCancel(); }

  void OnReadDone(bool ok) override {
    if (ok && link_->Read(this, &in_).ok()) {
      StartRead(&in_);
      return;
    }
    link_->End(this);
    if (ok) context_.TryCancel();
    RemoveHold();
  }
  void OnWriteDone(bool ok) override { link_->Written(this, ok); }
  void OnDone(const grpc::Status& status) override {
    PeerLink* const link = link_;
    link->Gone(this, status);
    delete this;
    link->Released();
  }

 private:
  PeerLink* const link_;
  grpc::ClientContext context_;
  v1::PeerMessage in_;
};

}  // namespace

absl::Status CheckHello(const LinkIdentity& identity, const v1::LinkHello& hello) {
  const auto differs = [&](const char* what, const auto& here, const auto& there, const char* remedy) {
    return absl::FailedPreconditionError(absl::StrCat("link refused by region ", identity.self, ": ", what, " is ",
                                                      here, " here and ", there, " in region ", hello.from(), "; ",
                                                      remedy));
  };
  if (hello.protocol_version() != identity.protocol_version) {
    return differs("protocol version", identity.protocol_version, hello.protocol_version(),
                   "run the same release on all servers");
  }
  if (hello.world_hash() != identity.world_hash) {
    return differs("world hash", absl::StrFormat("%016x", identity.world_hash),
                   absl::StrFormat("%016x", hello.world_hash()), "start all regions from the same world file");
  }
  if (hello.layout_epoch() != identity.layout_epoch) {
    return differs("layout epoch", identity.layout_epoch, hello.layout_epoch(),
                   "the control plane assigns one layout to all regions");
  }
  if (hello.exchange_delay() != static_cast<uint32_t>(identity.exchange_delay)) {
    return differs("exchange delay", identity.exchange_delay, hello.exchange_delay(), "use one exchange in a world");
  }
  if (hello.tick_us() != identity.tick_us) {
    return differs("tick length in us", identity.tick_us, hello.tick_us(), "use one tick length in a world");
  }
  if (hello.to() != identity.self) {
    return absl::FailedPreconditionError(absl::StrCat("link refused by region ", identity.self, ": region ",
                                                      hello.from(), " looks for region ", hello.to(),
                                                      " here; its layout has a wrong endpoint"));
  }
  return absl::OkStatus();
}

PeerLink::PeerLink(Options options)
    : options_(std::move(options)),
      sender_(options_.state.first, options_.state.kept),
      receiver_(options_.state.applied),
      durable_(options_.state.applied),
      backoff_ms_(kMinBackoffMs) {}

PeerLink::~PeerLink() { Close(); }

void PeerLink::Dial(const std::string& endpoint, const std::shared_ptr<grpc::ChannelCredentials>& credentials) {
  AUREOLE_CHECK(options_.identity.self < options_.peer && channel_ == nullptr, "region %d dials region %d",
                options_.identity.self, options_.peer);
  const std::lock_guard lock(mutex_);
  credentials_ = credentials;
  OpenChannel(endpoint);
  Connect();
}

// Holds the mutex.
void PeerLink::OpenChannel(const std::string& endpoint) {
  endpoint_ = endpoint;
  channel_ = PeerChannel(endpoint, credentials_);
  stub_ = v1::Peer::NewStub(channel_);
}

void PeerLink::Redirect(const std::string& endpoint, uint64_t incarnation) {
  const std::lock_guard lock(mutex_);
  const bool newer = incarnation > peer_incarnation_;
  const bool elsewhere = channel_ != nullptr && !endpoint.empty() && endpoint != endpoint_;
  if (closed_ || incarnation < peer_incarnation_ || (!newer && !elsewhere)) return;
  peer_incarnation_ = incarnation;
  if (newer) peer_met_ = false;
  if (elsewhere) {
    old_channels_.push_back(channel_);
    OpenChannel(endpoint);
  }
  if (current_ != nullptr) current_->Cancel();
}

void PeerLink::Send(EncodedFrame frame) {
  const std::lock_guard lock(mutex_);
  const uint64_t sequence = sender_.Push(frame);
  if (current_ == nullptr || !current_->open || sequence <= peer_applied_) return;
  current_->queue.emplace_back(sequence, std::move(frame));
  Pump(current_);
}

void PeerLink::SetDurable(uint64_t frames) {
  const std::lock_guard lock(mutex_);
  durable_ = std::max(durable_, frames);
  if (current_ != nullptr) Pump(current_);
}

LinkState PeerLink::State() const {
  const std::lock_guard lock(mutex_);
  return {epoch(), parted_ ? receiver_.applied() : 0, sender_.first(), sender_.messages()};
}

void PeerLink::Part() {
  const std::lock_guard lock(mutex_);
  parted_ = true;
  if (current_ != nullptr) Pump(current_);
}

bool PeerLink::released() const {
  const std::lock_guard lock(mutex_);
  return sender_.kept() == 0;
}

bool PeerLink::met() const {
  const std::lock_guard lock(mutex_);
  return peer_met_;
}

bool PeerLink::caught_up() const {
  const std::lock_guard lock(mutex_);
  return peer_met_ && peer_applied_ < sender_.next();
}

Tick PeerLink::log_until() const {
  const std::lock_guard lock(mutex_);
  return peer_log_until_;
}

void PeerLink::Cut() {
  const std::lock_guard lock(mutex_);
  if (current_ != nullptr) current_->Cancel();
}

bool PeerLink::AwaitWritten(std::chrono::milliseconds at_most) {
  std::unique_lock lock(mutex_);
  return changed_.wait_for(lock, at_most, [this] {
    return current_ != nullptr && current_->open && current_->queue.empty() && !current_->writing;
  });
}

void PeerLink::Close() {
  std::unique_lock lock(mutex_);
  closed_ = true;
  if (alarm_ != nullptr) alarm_->Cancel();
  if (current_ != nullptr) current_->Cancel();
  changed_.wait(lock, [this] { return streams_ == 0 && !redialling_; });
}

LinkStats PeerLink::stats() const {
  const std::lock_guard lock(mutex_);
  LinkStats out = stats_;
  out.frames_kept = static_cast<int64_t>(sender_.kept());
  return out;
}

v1::LinkHello PeerLink::Hello() const {
  v1::LinkHello hello;
  hello.set_protocol_version(options_.identity.protocol_version);
  hello.set_world_hash(options_.identity.world_hash);
  hello.set_layout_epoch(options_.identity.layout_epoch);
  hello.set_from(options_.identity.self);
  hello.set_to(options_.peer);
  hello.set_incarnation(options_.identity.incarnation);
  hello.set_exchange_delay(static_cast<uint32_t>(options_.identity.exchange_delay));
  hello.set_tick_us(options_.identity.tick_us);
  hello.set_applied(receiver_.applied());
  hello.set_keep(options_.keep);
  hello.set_durable(durable_);
  hello.set_log_until(options_.identity.log_until);
  return hello;
}

// Holds the mutex.
absl::Status PeerLink::Accept(LinkStream* stream, const v1::LinkHello& hello) {
  if (absl::Status s = CheckHello(options_.identity, hello); !s.ok()) return s;
  if (hello.from() != options_.peer) {
    return absl::FailedPreconditionError(absl::StrCat("link refused by region ", options_.identity.self, ": region ",
                                                      hello.from(), " answers for region ", options_.peer));
  }
  if (hello.incarnation() == 0 || hello.incarnation() < peer_incarnation_) {
    return absl::FailedPreconditionError(
        absl::StrCat("link refused by region ", options_.identity.self, ": region ", hello.from(), " is incarnation ",
                     hello.incarnation(), ", and incarnation ", peer_incarnation_, " is known: it has been replaced"));
  }
  if (hello.incarnation() > peer_incarnation_ && peer_incarnation_ != 0 && !hello.keep()) {
    return absl::FailedPreconditionError(absl::StrCat(
        "link refused by region ", options_.identity.self, ": region ", hello.from(), " is incarnation ",
        hello.incarnation(), ", was ", peer_incarnation_, "; without checkpoints it cannot go on from here"));
  }
  // Who was loaded from a checkpoint will make again what the peer already has.
  const bool ahead = options_.identity.incarnation > 1 && hello.applied() >= sender_.next();
  if (!ahead && !sender_.CanResume(hello.applied())) {
    return absl::FailedPreconditionError(absl::StrCat("link refused by region ", options_.identity.self, ": region ",
                                                      hello.from(), " has applied frame ", hello.applied(),
                                                      "; kept are the ", sender_.kept(), " before ", sender_.next()));
  }
  peer_incarnation_ = hello.incarnation();
  peer_met_ = true;
  peer_keeps_ = hello.keep();
  peer_log_until_ = std::max(peer_log_until_, hello.log_until());
  peer_applied_ = hello.applied();
  sender_.Acknowledge(peer_keeps_ ? hello.durable() : hello.applied());
  sender_.Resume(hello.applied(),
                 [&](uint64_t sequence, const EncodedFrame& frame) { stream->queue.emplace_back(sequence, frame); });
  stream->open = true;
  stream->greeted = true;
  last_refusal_.clear();
  if (stats_.connections++ > 0) ++stats_.reconnects;
  options_.log(options_.peer, absl::StrCat(stats_.reconnects == 0 ? "connected" : "connected again", ", ",
                                           stream->queue.size(), " frames to send"));
  changed_.notify_all();
  return absl::OkStatus();
}

absl::Status PeerLink::Attach(LinkStream* stream, const v1::LinkHello& hello) {
  const std::lock_guard lock(mutex_);
  if (closed_) return absl::UnavailableError("this region is shutting down");
  if (absl::Status s = Accept(stream, hello); !s.ok()) {
    ++stats_.refused_hellos;
    return s;
  }
  // From here on nothing that the old stream reads counts, so the number of applied frames that is told stands.
  if (current_ != nullptr) current_->Cancel();
  current_ = stream;
  ++streams_;
  told_ = receiver_.applied();
  told_durable_ = durable_;
  *stream->out.mutable_hello() = Hello();
  stream->writing = true;
  stream->StartWriting(&stream->out);
  return absl::OkStatus();
}

absl::Status PeerLink::ReadHello(LinkStream* stream, const v1::LinkHello& hello) {
  const std::lock_guard lock(mutex_);
  absl::Status s = stream->greeted ? absl::InvalidArgumentError("a second hello") : Accept(stream, hello);
  if (s.ok()) {
    Pump(stream);
    return s;
  }
  ++stats_.refused_hellos;
  LogOnce(std::string(s.message()));
  return s;
}

absl::Status PeerLink::Read(LinkStream* stream, v1::PeerMessage* message) {
  if (message->has_hello()) return ReadHello(stream, message->hello());
  {
    const std::lock_guard lock(mutex_);
    if (stream != current_) return absl::AbortedError("replaced by a newer stream");
    if (!stream->greeted) return absl::InvalidArgumentError("the first message is no hello");
  }
  std::string bytes;
  absl::StatusOr<bool> whole = Assemble(stream, message, &bytes);
  absl::Status s = whole.status();
  Frame frame;
  if (s.ok() && *whole) {
    absl::StatusOr<Frame> decoded = DecodeFrame(bytes, options_.peer, options_.identity.self);
    s = decoded.status();
    if (s.ok()) frame = *std::move(decoded);
  }
  const std::lock_guard lock(mutex_);
  if (stream != current_) return absl::AbortedError("replaced by a newer stream");
  if (s.ok()) s = Apply(stream, *message, *whole ? &frame : nullptr);
  if (!s.ok()) {
    ++stats_.refused_frames;
    options_.log(options_.peer, absl::StrCat("frame refused, link closed: ", std::string(s.message())));
  }
  return s;
}

// Puts the parts of a frame together; true when `frame` is whole. Without the mutex: only reads touch these fields.
absl::StatusOr<bool> PeerLink::Assemble(LinkStream* stream, v1::PeerMessage* message, std::string* frame) const {
  if (!message->has_frame()) {
    if (message->more() || message->sequence() != 0) return absl::InvalidArgumentError("a number without a frame");
    return false;
  }
  if (!stream->in_parts) {
    if (stream->last_read == 0 && message->sequence() == 0) {
      return absl::InvalidArgumentError("the first frame of a connection has no number");
    }
    stream->last_read = message->sequence() != 0 ? message->sequence() : stream->last_read + 1;
  } else if (message->sequence() != 0) {
    return absl::InvalidArgumentError("a new frame within another");
  }
  if (!stream->in_parts && !message->more()) {
    frame->swap(*message->mutable_frame());
    return true;
  }
  if (stream->parts.size() + message->frame().size() > kMaxFrameBytes) {
    return absl::InvalidArgumentError(absl::StrCat("a frame of more than ", kMaxFrameBytes, " bytes"));
  }
  stream->parts += message->frame();
  stream->in_parts = message->more();
  if (stream->in_parts) return false;
  frame->swap(stream->parts);
  stream->parts.clear();
  return true;
}

// Holds the mutex. `frame` is null when the message carries none, or only a part.
absl::Status PeerLink::Apply(LinkStream* stream, const v1::PeerMessage& message, Frame* frame) {
  const uint64_t durable = message.durable() != 0 || peer_keeps_ ? message.durable() : message.applied();
  if (std::max(durable, message.applied()) >= std::max(sender_.next(), peer_applied_ + 1)) {
    return absl::InvalidArgumentError(absl::StrCat("acknowledges frame ", durable, ", which was never sent"));
  }
  sender_.Acknowledge(durable);
  if (frame == nullptr) return absl::OkStatus();
  switch (receiver_.Check(stream->last_read)) {
    case LinkReceiver::Verdict::kApply:
      ++stats_.frames_received;
      backoff_ms_ = kMinBackoffMs;
      options_.deliver(std::move(*frame));
      Pump(stream);  // an acknowledgement may be due
      return absl::OkStatus();
    case LinkReceiver::Verdict::kDuplicate:
      ++stats_.duplicates;
      return absl::OkStatus();
    case LinkReceiver::Verdict::kGap:
      break;
  }
  return absl::InvalidArgumentError(
      absl::StrCat("frame ", stream->last_read, " after frame ", receiver_.applied(), ": some are missing"));
}

bool PeerLink::Written(LinkStream* stream, bool ok) {
  const std::lock_guard lock(mutex_);
  stream->writing = false;
  if (ok) {
    Pump(stream);
  } else {
    stream->open = false;
  }
  changed_.notify_all();
  return stream->ended;
}

bool PeerLink::End(LinkStream* stream) {
  const std::lock_guard lock(mutex_);
  stream->ended = true;
  stream->open = false;
  return !stream->writing;
}

void PeerLink::Gone(LinkStream* stream, const grpc::Status& status) {
  const std::lock_guard lock(mutex_);
  if (current_ == stream) {
    current_ = nullptr;
    if (status.error_code() == grpc::StatusCode::FAILED_PRECONDITION) ++stats_.refused_hellos;
    if (!closed_ && stream->greeted) options_.log(options_.peer, "connection lost: " + status.error_message());
    // A hello that this side did not accept was cancelled, and has been logged.
    if (!closed_ && !stream->greeted && status.error_code() != grpc::StatusCode::CANCELLED) {
      LogOnce(status.error_message());
    }
    if (channel_ != nullptr && !closed_) Redial();
  }
}

void PeerLink::Released() {
  const std::lock_guard lock(mutex_);
  --streams_;
  changed_.notify_all();
}

// Holds the mutex. A standing reason is logged once, not at every attempt.
void PeerLink::LogOnce(const std::string& why) {
  if (why == last_refusal_) return;
  last_refusal_ = why;
  options_.log(options_.peer, "no connection: " + why);
}

// Holds the mutex. Starts the next write, if there is one and none is in flight.
void PeerLink::Pump(LinkStream* stream) {
  if (stream->ended || !stream->open || stream->writing) return;
  const uint64_t due = parted_ ? 1 : kAcknowledgeEvery;
  const bool acknowledge = options_.keep ? durable_ > told_durable_ : receiver_.applied() - told_ >= due;
  if (stream->queue.empty() && !acknowledge) return;
  v1::PeerMessage& out = stream->out;
  out.Clear();
  if (acknowledge) {
    out.set_applied(told_ = receiver_.applied());
    if (options_.keep) out.set_durable(told_durable_ = durable_);
  }
  if (!stream->queue.empty()) PutFrame(stream);
  stats_.bytes_sent += static_cast<int64_t>(out.ByteSizeLong());
  stream->writing = true;
  stream->StartWriting(&out);
}

// Holds the mutex. Puts the next frame, or a part of it, into the message.
void PeerLink::PutFrame(LinkStream* stream) {
  v1::PeerMessage& out = stream->out;
  const auto& [sequence, frame] = stream->queue.front();
  if (!stream->sequence_said) out.set_sequence(sequence);
  stream->sequence_said = true;
  const size_t part = std::min(kPartBytes, frame->size() - stream->written);
  out.set_frame(frame->data() + stream->written, part);
  stream->written += part;
  if (stream->written < frame->size()) {
    out.set_more(true);
  } else {
    stream->written = 0;
    stream->queue.pop_front();
    ++stats_.frames_sent;
  }
}

// Holds the mutex.
void PeerLink::Connect() {
  auto* stream = new DialStream(this);
  current_ = stream;
  ++streams_;
  told_ = receiver_.applied();
  told_durable_ = durable_;
  *stream->out.mutable_hello() = Hello();
  stream->writing = true;
  stream->Start(stub_.get());
}

// Holds the mutex. A new alarm each time: gRPC may still be returning from the last one's callback.
void PeerLink::Redial() {
  redialling_ = true;
  alarm_ = std::make_unique<grpc::Alarm>();
  alarm_->Set(std::chrono::system_clock::now() + std::chrono::milliseconds(backoff_ms_), [this](bool) {
    const std::lock_guard lock(mutex_);
    redialling_ = false;
    if (!closed_) Connect();
    changed_.notify_all();
  });
  backoff_ms_ = std::min(2 * backoff_ms_, kMaxBackoffMs);
}

}  // namespace aureole
