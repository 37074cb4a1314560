#include "server/region/copy_sender.h"

#include <algorithm>

#include <absl/strings/str_cat.h>

#include "server/transport/link_limits.h"
#include "server/transport/peer_channel.h"

namespace aureole {
namespace {

constexpr size_t kCopyPartBytes = size_t{256} << 10;
// The peers of a world that begins come one after another: until then, no failure to connect is worth telling.
constexpr std::chrono::seconds kPatience{5};

}  // namespace

RegionId KeeperOf(RegionId region, const std::vector<RegionId>& members) {
  RegionId first = kNoRegion, next = kNoRegion;
  for (RegionId member : members) {
    if (member == region) continue;
    if (first == kNoRegion || member < first) first = member;
    if (member > region && (next == kNoRegion || member < next)) next = member;
  }
  return next != kNoRegion ? next : first;
}

v1::CopyOf CopyOfMessage(const CopyIdentity& identity, RegionId keeper) {
  v1::CopyOf out;
  out.set_protocol_version(kPeerProtocolVersion);
  out.set_world_hash(identity.world_hash);
  out.set_region(identity.region);
  out.set_incarnation(identity.incarnation);
  out.set_keeper(keeper);
  return out;
}

CopySender::CopySender(const CopyIdentity& identity, Tick least, std::function<void(const std::string&)> log)
    : identity_(identity), begins_(least == 0), log_(std::move(log)), forgot_(least) {}

CopySender::~CopySender() {
  {
    const std::lock_guard lock(mutex_);
    stopped_ = true;
    if (context_ != nullptr) context_->TryCancel();
  }
  changed_.notify_all();
  if (thread_.joinable()) thread_.join();
}

void CopySender::Connect(RegionId keeper, std::vector<std::string> endpoints,
                         std::shared_ptr<grpc::ChannelCredentials> credentials) {
  const std::lock_guard lock(mutex_);
  keeper_ = keeper;
  endpoints_ = std::move(endpoints);
  incarnations_.resize(endpoints_.size());
  credentials_ = std::move(credentials);
  connecting_since_ = Clock::now();
  thread_ = std::thread([this] { Run(); });
}

void CopySender::Redirect(RegionId region, const std::string& endpoint, uint64_t incarnation) {
  const std::lock_guard lock(mutex_);
  const auto i = static_cast<size_t>(region);
  if (endpoints_.size() <= i) endpoints_.resize(i + 1);
  incarnations_.resize(endpoints_.size());
  if (incarnation < incarnations_[i]) return;
  const bool other =
      (!endpoint.empty() && endpoint != endpoints_[i]) || (incarnations_[i] != 0 && incarnation > incarnations_[i]);
  incarnations_[i] = incarnation;
  if (!endpoint.empty()) endpoints_[i] = endpoint;
  if (region != keeper_) return;
  if (other) Lose(absl::StrCat("its keeper, region ", region, ", has been replaced"));
  ++dials_;
  changed_.notify_all();
}

void CopySender::Begin(Tick tick, RegionId keeper) {
  const std::lock_guard lock(mutex_);
  if (keeper != keeper_) {
    keeper_ = keeper;
    ++dials_;
    copied_ = 0;
    Lose(keeper == kNoRegion ? std::string("no other region is left to keep a copy")
                             : absl::StrCat("its keeper is region ", keeper, " from here on"));
  }
  if (shipping_ != 0 && ++passed_over_ == 2) {
    Lose(absl::StrCat("its keeper, region ", keeper_, ", has not made a checkpoint durable before two more were made"));
  }
  if (!open_ || lost_ || shipping_ != 0) return;
  shipping_ = tick;
  passed_over_ = 0;
  if (streaming_) return;
  streaming_ = true;
  if (newest_.tick <= tick) return;
  batches_.push_back(newest_);
  waiting_bytes_ += newest_.records->size();
  changed_.notify_all();
}

void CopySender::Ship(Tick tick, std::shared_ptr<const std::string> checkpoint) {
  {
    const std::lock_guard lock(mutex_);
    if (shipping_ != tick) return;  // lost, or the one before is not through
    checkpoint_ = std::move(checkpoint);
    checkpoint_written_ = 0;
  }
  changed_.notify_all();
}

void CopySender::Log(Tick tick, const std::string& records) {
  {
    const std::lock_guard lock(mutex_);
    newest_ = {tick, std::make_shared<const std::string>(records)};
    logged_at_ = Clock::now();
    if (!streaming_) return;
    batches_.push_back(newest_);
    waiting_bytes_ += records.size();
    if (waiting_bytes_ > kMostWaiting) Lose(absl::StrCat("its keeper, region ", keeper_, ", is too slow"));
  }
  changed_.notify_all();
}

void CopySender::AwaitLogged() {
  std::unique_lock lock(mutex_);
  changed_.wait_until(lock, logged_at_ + kLongestLog,
                      [this] { return !covers_ || copied_inputs_ >= newest_.tick || fenced_; });
  if (covers_ && copied_inputs_ >= newest_.tick) return;
  if (covers_) {
    Lose(absl::StrCat("its keeper, region ", keeper_, ", has not made inputs durable within ", kLongestLog.count(),
                      " ms"));
  }
  if (keeper_ != kNoRegion) alone_ = newest_.tick;
}

Tick CopySender::MostToForget(Tick newest) {
  const std::lock_guard lock(mutex_);
  Tick most = newest;
  if (covers_) {
    most = std::min(most, copied_);
  } else if (streaming_) {
    most = std::min(most, std::max(copied_, shipping_));  // it will cover from there on
  }
  forgot_ = std::max(forgot_, most);
  return most;
}

bool CopySender::fenced() const {
  const std::lock_guard lock(mutex_);
  return fenced_;
}

CopySender::Stats CopySender::stats() const {
  const std::lock_guard lock(mutex_);
  Stats out;
  out.keeper = keeper_;
  out.tick = copied_;
  out.shipping = shipping_;
  out.covers = covers_;
  out.failures = failures_;
  const bool tell = has_covered_ || refused_ || Clock::now() - connecting_since_ > kPatience;
  if (!covers_ && tell && keeper_ != kNoRegion) out.failure = why_lost_;
  out.alone = !covers_ && alone_ > 0;
  out.least_tick = covers_ ? forgot_ : std::max(forgot_, alone_);
  return out;
}

// Holds the mutex. The region goes on alone; the connection ends.
void CopySender::Lose(const std::string& why) {
  if (covers_) ++failures_;
  if (!lost_) why_lost_ = why;
  lost_ = true;
  open_ = streaming_ = covers_ = false;
  shipping_ = 0;
  checkpoint_.reset();
  batches_.clear();
  waiting_bytes_ = batch_written_ = 0;
  copied_inputs_ = 0;
  if (context_ != nullptr) context_->TryCancel();
  changed_.notify_all();
}

// Holds the mutex.
bool CopySender::CanDial() const {
  return keeper_ != kNoRegion && static_cast<size_t>(keeper_) < endpoints_.size() && !endpoints_[keeper_].empty();
}

void CopySender::Run() {
  std::unique_lock lock(mutex_);
  for (int backoff_ms = kMinBackoffMs;;) {
    changed_.wait(lock, [this] { return stopped_ || CanDial(); });
    if (stopped_) return;
    const uint64_t dials = dials_;
    const bool covered = Converse(&lock);
    if (stopped_ || fenced_) return;
    backoff_ms = covered ? kMinBackoffMs : std::min(2 * backoff_ms, kMaxBackoffMs);
    const bool at_once = changed_.wait_for(lock, std::chrono::milliseconds(backoff_ms),
                                           [this, dials] { return stopped_ || dials_ != dials; });
    if (at_once) backoff_ms = kMinBackoffMs;
  }
}

// One connection, from its beginning to its end. True when the keeper came to cover the region.
bool CopySender::Converse(std::unique_lock<std::mutex>* lock) {
  const RegionId keeper = keeper_;
  const std::string endpoint = endpoints_[keeper];
  grpc::ClientContext context;
  context_ = &context;
  lost_ = ended_ = covered_ = false;
  const bool begins = begins_ && !has_covered_;
  lock->unlock();
  const auto stub = v1::Copies::NewStub(PeerChannel(endpoint, credentials_));
  const std::unique_ptr<Stream> stream = stub->Keep(&context);
  std::thread reader([this, &stream] { ReadAll(stream.get()); });
  v1::KeepMessage hello;
  *hello.mutable_of() = CopyOfMessage(identity_, keeper);
  hello.mutable_of()->set_begins(begins);
  stream->Write(hello);
  lock->lock();
  WriteParts(lock, stream.get());
  lock->unlock();
  reader.join();  // what is lost, or stopped, was cancelled; else the keeper says why it has ended
  const grpc::Status status = stream->Finish();
  lock->lock();
  context_ = nullptr;
  if (status.error_code() == grpc::StatusCode::ABORTED) fenced_ = true;
  refused_ = status.error_code() == grpc::StatusCode::FAILED_PRECONDITION;
  Lose(absl::StrCat("its keeper, region ", keeper, ": ", status.error_message()));
  if (!stopped_ && why_lost_ != last_logged_) log_(absl::StrCat("no copy: ", why_lost_));
  last_logged_ = why_lost_;
  return covered_;
}

// Until the connection is lost. Holds the mutex but while it writes.
void CopySender::WriteParts(std::unique_lock<std::mutex>* lock, Stream* stream) {
  v1::KeepMessage message;
  for (;;) {
    changed_.wait(*lock, [this] { return stopped_ || lost_ || ended_ || checkpoint_ != nullptr || !batches_.empty(); });
    if (stopped_ || lost_ || ended_) return;
    NextPart(message.mutable_part());
    lock->unlock();
    const bool written = stream->Write(message);
    lock->lock();
    if (!written) return;
  }
}

// Holds the mutex. Inputs do not wait for a checkpoint.
void CopySender::NextPart(v1::CopyPart* part) {
  if (!batches_.empty()) {
    const Batch& batch = batches_.front();
    const size_t bytes = std::min(kCopyPartBytes, batch.records->size() - batch_written_);
    part->set_inputs(batch.records->data() + batch_written_, bytes);
    part->set_tick(batch.tick);
    batch_written_ += bytes;
    part->set_more(batch_written_ < batch.records->size());
    if (part->more()) return;
    waiting_bytes_ -= batch.records->size();
    batch_written_ = 0;
    batches_.pop_front();
    return;
  }
  const size_t bytes = std::min(kCopyPartBytes, checkpoint_->size() - checkpoint_written_);
  part->set_checkpoint(checkpoint_->data() + checkpoint_written_, bytes);
  part->set_tick(shipping_);
  checkpoint_written_ += bytes;
  part->set_more(checkpoint_written_ < checkpoint_->size());
  if (!part->more()) checkpoint_.reset();
}

void CopySender::ReadAll(Stream* stream) {
  v1::Kept kept;
  while (stream->Read(&kept)) {
    const std::lock_guard lock(mutex_);
    Heard(kept);
  }
  const std::lock_guard lock(mutex_);
  ended_ = true;
  changed_.notify_all();
}

// Holds the mutex.
void CopySender::Heard(const v1::Kept& kept) {
  if (lost_) return;
  open_ = true;
  if (!has_covered_) why_lost_.clear();  // it has only not been there yet
  copied_inputs_ = std::max(copied_inputs_, kept.inputs_tick());
  if (shipping_ != 0 && kept.checkpoint_tick() == shipping_) {
    copied_ = std::exchange(shipping_, 0);
  }
  const bool whole = streaming_ && copied_ != 0 && kept.checkpoint_tick() == copied_;
  if (!covers_ && whole && copied_ >= forgot_ && (alone_ <= copied_ || alone_ <= copied_inputs_)) {
    covers_ = covered_ = has_covered_ = true;
    alone_ = 0;
    last_logged_.clear();
    log_(absl::StrCat("copied to region ", keeper_, " from tick ", copied_, " on"));
  }
  changed_.notify_all();
}

}  // namespace aureole
