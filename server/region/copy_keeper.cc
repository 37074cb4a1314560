#include "server/region/copy_keeper.h"

#include <algorithm>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/transport/link_limits.h"

namespace aureole {
namespace {

// More than any region has; what is beyond comes from a broken peer.
constexpr size_t kMostCheckpointBytes = size_t{1} << 30, kMostInputsBytes = size_t{64} << 20;
constexpr size_t kCopyPartBytes = size_t{256} << 10;

grpc::Status ToGrpc(const absl::Status& s) {
  return {static_cast<grpc::StatusCode>(s.code()), std::string(s.message())};
}

}  // namespace

// A call of Keep. It has at most one message in hand, so that whoever is faster than this disk waits.
class CopyKeeper::Stream final : public grpc::ServerBidiReactor<v1::KeepMessage, v1::Kept> {
 public:
  explicit Stream(CopyKeeper* keeper) : keeper_(keeper) { StartRead(&in_); }

  RegionId region = kNoRegion;  // once it is admitted
  uint64_t incarnation = 0;

  // Within Do.
  absl::Status Open(const std::filesystem::path& directory, bool begins) {
    std::error_code error;
    if (begins) std::filesystem::remove_all(directory, error);
    absl::StatusOr<std::unique_ptr<Journal>> journal =
        Journal::Open(directory, incarnation, [this](const Journal::Stats& stats) { Tell(stats); });
    if (!journal.ok()) return journal.status();
    if (absl::Status s = (*journal)->Continue(); !s.ok()) return s;
    journal_ = *std::move(journal);
    Tell({});
    return absl::OkStatus();
  }
  void End(const absl::Status& why) {
    const std::lock_guard lock(mutex_);
    EndLocked(why);
  }
  // Nothing becomes durable for it any more.
  void CloseJournal() { journal_.reset(); }

  void OnReadDone(bool ok) override {
    keeper_->Do([this, ok] {
      const absl::Status s = ok ? Take() : absl::UnavailableError("connection closed");
      const std::lock_guard lock(mutex_);
      if (!s.ok()) return EndLocked(s);
      if (!ending_) StartRead(&in_);
    });
  }
  void OnWriteDone(bool ok) override {
    const std::lock_guard lock(mutex_);
    writing_ = false;
    if (ending_) return Finish(verdict_);
    if (ok && told_.SerializeAsString() != kept_.SerializeAsString()) Write();
  }
  void OnDone() override {
    keeper_->Do([this] { keeper_->Forget(this); });
  }

 private:
  absl::Status Take() {
    if (in_.has_of()) {
      if (region != kNoRegion) return absl::InvalidArgumentError("says again whose copy it is");
      return keeper_->Admit(this, in_.of());
    }
    if (journal_ == nullptr) return absl::InvalidArgumentError("the first message must say whose copy it is");
    v1::CopyPart* const part = in_.mutable_part();
    switch (part->kind_case()) {
      case v1::CopyPart::kInputs:
        return TakeInputs(part);
      case v1::CopyPart::kCheckpoint:
        return TakeCheckpoint(part);
      default:
        return absl::InvalidArgumentError("a part of no known kind");
    }
  }

  absl::Status TakeInputs(v1::CopyPart* part) {
    if (inputs_.size() + part->inputs().size() > kMostInputsBytes || part->tick() <= inputs_tick_) {
      return absl::InvalidArgumentError("inputs that are too many, or of no later tick than those before");
    }
    inputs_ += part->inputs();
    if (part->more()) return absl::OkStatus();
    inputs_tick_ = part->tick();
    journal_->LogRecords(part->tick(), std::exchange(inputs_, {}));
    return absl::OkStatus();
  }

  absl::Status TakeCheckpoint(v1::CopyPart* part) {
    if (checkpoint_.size() + part->checkpoint().size() > kMostCheckpointBytes) {
      return absl::InvalidArgumentError(absl::StrCat("a checkpoint of more than ", kMostCheckpointBytes, " bytes"));
    }
    checkpoint_ += part->checkpoint();
    if (part->more()) return absl::OkStatus();
    // The one before is replaced: not by something that cannot be loaded.
    const absl::StatusOr<Checkpoint> whole = DecodeCheckpoint(checkpoint_);
    if (!whole.ok()) return absl::InvalidArgumentError(whole.status().message());
    if (whole->region != region || whole->tick != part->tick() || journal_->writing()) {
      return absl::InvalidArgumentError("a checkpoint of another region or tick, or before the last one is durable");
    }
    journal_->WriteEncoded(part->tick(), std::exchange(checkpoint_, {}));
    return absl::OkStatus();
  }

  // The journal's threads.
  void Tell(const Journal::Stats& stats) {
    const std::lock_guard lock(mutex_);
    if (stats.failures > 0) return EndLocked(absl::UnavailableError(stats.last_failure));
    told_.set_checkpoint_tick(std::max<int64_t>(told_.checkpoint_tick(), stats.durable_tick));
    told_.set_inputs_tick(std::max<int64_t>(told_.inputs_tick(), stats.logged_tick));
    if (!writing_ && !ending_) Write();
  }
  void Write() {
    writing_ = true;
    kept_ = told_;
    StartWrite(&kept_);
  }
  // When a write is in flight, its end finishes the call.
  void EndLocked(const absl::Status& why) {
    if (ending_) return;
    ending_ = true;
    verdict_ = ToGrpc(why);
    if (!writing_) Finish(verdict_);
  }

  CopyKeeper* const keeper_;
  v1::KeepMessage in_;
  // Within Do.
  std::unique_ptr<Journal> journal_;
  std::string checkpoint_, inputs_;  // parts of what is not whole yet
  Tick inputs_tick_ = 0;

  std::mutex mutex_;
  v1::Kept told_, kept_;  // to be said; in flight, or said last
  bool writing_ = false, ending_ = false;
  grpc::Status verdict_;
};

// A call of Fetch.
class CopyKeeper::Reply final : public grpc::ServerWriteReactor<v1::CopyPart> {
 public:
  Reply(CopyKeeper* keeper, const v1::CopyOf& of) : keeper_(keeper) {
    keeper_->Do([this, of] {
      absl::StatusOr<Journal::Recovered> found = keeper_->Take(of);
      if (!found.ok()) return Finish(ToGrpc(found.status()));
      out_.set_tick(found->checkpoint.tick);
      inputs_ = EncodeInputs(found->inputs);
      checkpoint_ = EncodeCheckpoint(found->checkpoint);
      Next();
    });
  }

  void OnWriteDone(bool ok) override {
    if (!ok) return Finish({grpc::StatusCode::UNAVAILABLE, "connection closed"});
    Next();
  }
  void OnDone() override {
    keeper_->Do([this] { keeper_->Forget(this); });
  }

 private:
  void Next() {
    const bool more = written_ < checkpoint_.size();
    const std::string& from = more ? checkpoint_ : inputs_;
    const size_t at = more ? written_ : written_ - checkpoint_.size();
    const size_t bytes = std::min(kCopyPartBytes, from.size() - at);
    if (bytes == 0) return Finish(grpc::Status::OK);
    if (more) {
      out_.set_checkpoint(from.data() + at, bytes);
    } else {
      out_.set_inputs(from.data() + at, bytes);
    }
    written_ += bytes;
    out_.set_more(at + bytes < from.size());
    StartWrite(&out_);
  }

  CopyKeeper* const keeper_;
  v1::CopyPart out_;
  std::string checkpoint_, inputs_;
  size_t written_ = 0;  // of both
};

CopyKeeper::CopyKeeper(std::filesystem::path directory)
    : directory_(std::move(directory)), thread_([this] { Work(); }) {}

CopyKeeper::~CopyKeeper() {
  {
    std::unique_lock lock(mutex_);
    changed_.wait(lock, [this] { return calls_ == 0; });
    stopped_ = true;
  }
  changed_.notify_all();
  thread_.join();
}

void CopyKeeper::Serve(uint64_t world_hash, RegionId self) {
  const std::lock_guard lock(mutex_);
  world_hash_ = world_hash;
  self_ = self;
  serving_ = true;
}

void CopyKeeper::Do(std::function<void()> work) {
  {
    const std::lock_guard lock(mutex_);
    work_.push_back(std::move(work));
  }
  changed_.notify_all();
}

void CopyKeeper::Work() {
  std::unique_lock lock(mutex_);
  for (;;) {
    changed_.wait(lock, [this] { return stopped_ || !work_.empty(); });
    if (work_.empty()) return;
    const std::function<void()> work = std::move(work_.front());
    work_.pop_front();
    lock.unlock();
    work();
    lock.lock();
  }
}

grpc::ServerBidiReactor<v1::KeepMessage, v1::Kept>* CopyKeeper::Keep(grpc::CallbackServerContext*) {
  {
    const std::lock_guard lock(mutex_);
    ++calls_;
  }
  return new Stream(this);
}

grpc::ServerWriteReactor<v1::CopyPart>* CopyKeeper::Fetch(grpc::CallbackServerContext*, const v1::CopyOf* request) {
  {
    const std::lock_guard lock(mutex_);
    ++calls_;
  }
  return new Reply(this, *request);
}

std::filesystem::path CopyKeeper::DirectoryOf(RegionId region) const {
  return directory_ / absl::StrCat("region-", region);
}

// To keep a copy, this server must know what it is itself; what it has kept it can give away before.
absl::Status CopyKeeper::Check(const v1::CopyOf& of, bool keep) {
  if (directory_.empty()) {
    return absl::FailedPreconditionError("this server has no directory for copies; start it with --data");
  }
  if (of.protocol_version() != kPeerProtocolVersion) {
    return absl::FailedPreconditionError(absl::StrCat("protocol version is ", kPeerProtocolVersion, " here and ",
                                                      of.protocol_version(), " in region ", of.region(),
                                                      "; run the same release on all servers"));
  }
  if (of.region() < 0 || of.region() == of.keeper() || of.incarnation() == 0) {
    return absl::InvalidArgumentError("region, keeper, incarnation: make no sense");
  }
  const std::lock_guard lock(mutex_);
  if (!serving_ && keep) return absl::UnavailableError("this server has no region at present");
  if (serving_ && of.keeper() != self_) {
    return absl::FailedPreconditionError(
        absl::StrCat("region ", of.region(), " looks for region ", of.keeper(), " here, this is region ", self_));
  }
  if (serving_ && of.world_hash() != world_hash_) {
    return absl::FailedPreconditionError("world_hash: is of another world; start all regions from the same world file");
  }
  return absl::OkStatus();
}

absl::Status CopyKeeper::Admit(Stream* stream, const v1::CopyOf& of) {
  if (absl::Status s = Check(of, true); !s.ok()) return s;
  // A volume that is gone is not made again on what is beneath it.
  std::error_code error;
  if (!std::filesystem::exists(directory_.parent_path(), error)) {
    return absl::UnavailableError(absl::StrCat(directory_.parent_path().string(), " is gone"));
  }
  const auto old = streams_.find(of.region());
  if (old != streams_.end() && old->second->incarnation > of.incarnation()) {
    return absl::AbortedError("a later incarnation of the region has its copy here");
  }
  Fence(of.region(), of.incarnation());
  stream->region = of.region();
  stream->incarnation = of.incarnation();
  if (absl::Status s = stream->Open(DirectoryOf(of.region()), of.begins()); !s.ok()) return s;
  streams_[of.region()] = stream;
  return absl::OkStatus();
}

absl::StatusOr<Journal::Recovered> CopyKeeper::Take(const v1::CopyOf& of) {
  if (absl::Status s = Check(of, false); !s.ok()) return s;
  const std::filesystem::path directory = DirectoryOf(of.region());
  std::error_code error;
  if (!std::filesystem::exists(directory, error)) return absl::NotFoundError(absl::StrCat("no ", directory.string()));
  Fence(of.region(), of.incarnation());
  const absl::StatusOr<std::unique_ptr<Journal>> journal = Journal::Open(directory, of.incarnation());
  if (!journal.ok()) return journal.status();
  return (*journal)->Recover(of.world_hash(), of.region(), {});
}

// No stream of this or an earlier incarnation makes anything durable any more.
void CopyKeeper::Fence(RegionId region, uint64_t incarnation) {
  const auto old = streams_.find(region);
  if (old == streams_.end() || old->second->incarnation > incarnation) return;
  old->second->CloseJournal();
  old->second->End(old->second->incarnation < incarnation
                       ? absl::AbortedError(absl::StrCat("fenced by incarnation ", incarnation, " of the region"))
                       : absl::UnavailableError("the region has connected again"));
  streams_.erase(old);
}

void CopyKeeper::Forget(Stream* stream) {
  const auto found = streams_.find(stream->region);
  if (found != streams_.end() && found->second == stream) streams_.erase(found);
  stream->CloseJournal();  // whose threads may still be telling it something
  delete stream;
  Over();
}

void CopyKeeper::Forget(Reply* reply) {
  delete reply;
  Over();
}

void CopyKeeper::Over() {
  const std::lock_guard lock(mutex_);
  --calls_;
  changed_.notify_all();
}

}  // namespace aureole
