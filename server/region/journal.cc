#include "server/region/journal.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstring>
#include <fstream>
#include <iterator>
#include <system_error>

#include <absl/strings/match.h>
#include <absl/strings/numbers.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/strings/str_split.h>

#include "server/core/archive.h"
#include "server/core/check.h"
#include "server/region/check_sum.h"

namespace aureole {
namespace {

constexpr const char* kCheckpoint = "checkpoint";
constexpr const char* kLog = "inputs";  // segments are inputs-INCARNATION-NUMBER

absl::Status FileError(const char* what, const std::filesystem::path& path) {
  return absl::UnavailableError(absl::StrCat("cannot ", what, " ", path.string(), ": ", std::strerror(errno)));
}

absl::Status WriteAll(int file, const std::string& bytes, const std::filesystem::path& path) {
  for (size_t done = 0; done < bytes.size();) {
    const ssize_t n = write(file, bytes.data() + done, bytes.size() - done);
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) return FileError("write", path);
    done += static_cast<size_t>(n);
  }
  return absl::OkStatus();
}

absl::Status SyncDirectory(const std::filesystem::path& directory) {
  const int file = open(directory.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (file < 0) return FileError("open", directory);
  const bool synced = fsync(file) == 0;
  close(file);
  return synced ? absl::OkStatus() : FileError("sync", directory);
}

absl::Status WriteAtomically(const std::filesystem::path& path, const std::string& bytes) {
  const std::filesystem::path next = path.string() + ".new";
  const int file = open(next.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
  if (file < 0) return FileError("write", next);
  absl::Status s = WriteAll(file, bytes, next);
  if (s.ok() && fsync(file) != 0) s = FileError("sync", next);
  if (close(file) != 0 && s.ok()) s = FileError("close", next);
  if (s.ok() && std::rename(next.c_str(), path.c_str()) != 0) s = FileError("rename", next);
  return s.ok() ? SyncDirectory(path.parent_path()) : s;
}

absl::StatusOr<std::string> ReadAll(const std::filesystem::path& path) {
  std::ifstream in(path, std::ios::binary);
  if (!in) return absl::NotFoundError(absl::StrCat("no ", path.string()));
  std::string bytes(std::istreambuf_iterator<char>(in), {});
  if (in.bad()) return FileError("read", path);
  return bytes;
}

// A record: size and check sum of what follows; tick, input.
void AppendRecord(Tick n, const Input& input, std::string* out) {
  std::string body;
  Writer writer(&body);
  writer(n, input);
  Writer head(out);
  head(static_cast<uint32_t>(body.size()), CheckSum(body));
  out->append(body);
}

// The records of a file, in order. A torn one at the end was never told to anybody; in the last file, which may not
// have been synced, whatever is wrong is torn.
absl::Status ReadRecords(std::string_view bytes, bool last, std::vector<LoggedInput>* out) {
  constexpr size_t kHead = 2 * sizeof(uint32_t);
  while (!bytes.empty()) {
    uint32_t size = 0, sum = 0;
    Reader head(bytes.substr(0, kHead));
    head(size, sum);
    if (!head.ok() || bytes.size() - kHead < size) return absl::OkStatus();
    const std::string_view body = bytes.substr(kHead, size);
    LoggedInput record;
    Reader reader(body);
    reader(record.tick, record.input);
    if (CheckSum(body) != sum || !reader.done()) {
      return last ? absl::OkStatus() : absl::DataLossError("the log of inputs is damaged");
    }
    out->push_back(std::move(record));
    bytes.remove_prefix(kHead + size);
  }
  return absl::OkStatus();
}

}  // namespace

std::string EncodeInputs(const std::vector<LoggedInput>& inputs) {
  std::string out;
  for (const LoggedInput& l : inputs) AppendRecord(l.tick, l.input, &out);
  return out;
}

absl::StatusOr<std::vector<LoggedInput>> DecodeInputs(std::string_view bytes) {
  std::vector<LoggedInput> out;
  if (absl::Status s = ReadRecords(bytes, false, &out); !s.ok()) return s;
  return out;
}

Journal::Journal(std::filesystem::path root, uint64_t incarnation, std::function<void(const Stats&)> changed)
    : root_(std::move(root)),
      directory_(root_ / absl::StrCat("i", incarnation)),
      incarnation_(incarnation),
      told_(std::move(changed)) {}

absl::StatusOr<std::unique_ptr<Journal>> Journal::Open(const std::filesystem::path& directory, uint64_t incarnation,
                                                       std::function<void(const Stats&)> changed) {
  std::error_code error;
  std::filesystem::create_directories(directory, error);
  if (error) return absl::UnavailableError(absl::StrCat("cannot make ", directory.string(), ": ", error.message()));
  if (absl::Status s = WriteAtomically(directory / "writable", ""); !s.ok()) return s;
  std::unique_ptr<Journal> out(new Journal(directory, incarnation, std::move(changed)));
  Journal* const j = out.get();
  j->checkpoint_thread_ = std::thread([j] { j->WriteCheckpoints(); });
  j->log_thread_ = std::thread([j] { j->WriteLog(); });
  return out;
}

Journal::~Journal() {
  {
    const std::lock_guard lock(mutex_);
    stopped_ = true;
  }
  changed_.notify_all();
  checkpoint_thread_.join();
  log_thread_.join();
  if (log_file_ >= 0) close(log_file_);
}

// The directories that are here, by incarnation.
std::map<uint64_t, std::filesystem::path> Journal::Incarnations() const {
  std::map<uint64_t, std::filesystem::path> out;
  std::error_code error;
  for (const auto& entry : std::filesystem::directory_iterator(root_, error)) {
    const std::string name = entry.path().filename().string();
    uint64_t incarnation = 0;
    if (absl::StartsWith(name, "i") && absl::SimpleAtoi(name.substr(1), &incarnation)) {
      out[incarnation] = entry.path();
    }
  }
  return out;
}

// To be asked after something was written: only then it is known that the next incarnation has seen it.
bool Journal::TakenOver() const {
  std::error_code error;
  if (std::filesystem::exists(directory_, error)) return false;
  const std::map<uint64_t, std::filesystem::path> all = Incarnations();
  return !all.empty() && all.rbegin()->first > incarnation_;
}

absl::Status Journal::TakeOver(uint64_t least) {
  const std::map<uint64_t, std::filesystem::path> all = Incarnations();
  if (all.empty()) return absl::NotFoundError(absl::StrCat("no ", (root_ / "iN" / kCheckpoint).string()));
  const auto& [newest, path] = *all.rbegin();
  if (newest > incarnation_) {
    return absl::AbortedError(absl::StrCat(path.string(), " is of a later incarnation than this, ", incarnation_));
  }
  if (newest < least) {
    return absl::FailedPreconditionError(
        absl::StrCat(path.string(), " is stale: incarnation ", least, " has gone on elsewhere"));
  }
  if (newest == incarnation_) return absl::OkStatus();
  if (std::rename(path.c_str(), directory_.c_str()) != 0) return FileError("rename", path);
  return SyncDirectory(root_);
}

// The segments of the latest incarnation that has any hold all that is needed; a later one replaces what those before
// it have of its ticks. They are put together in one of this incarnation, since a fenced one may still write to those
// it has open.
absl::Status Journal::ReadLog(Recovered* out) {
  std::map<uint64_t, std::map<int64_t, std::filesystem::path>> found;
  std::error_code error;
  for (const auto& entry : std::filesystem::directory_iterator(directory_, error)) {
    const std::string name = entry.path().filename().string();
    const std::vector<std::string> words = absl::StrSplit(name, '-');
    uint64_t incarnation = 0;
    int64_t number = 0;
    if (words.size() != 3 || words[0] != kLog || !absl::SimpleAtoi(words[1], &incarnation) ||
        !absl::SimpleAtoi(words[2], &number)) {
      continue;
    }
    found[incarnation][number] = entry.path();
  }
  if (found.empty()) return absl::OkStatus();
  const auto& files = found.rbegin()->second;
  for (const auto& [number, path] : files) {
    const absl::StatusOr<std::string> records = ReadAll(path);
    if (!records.ok()) return records.status();
    std::vector<LoggedInput> inputs;
    if (absl::Status s = ReadRecords(*records, number == files.rbegin()->first, &inputs); !s.ok()) {
      return absl::DataLossError(absl::StrCat(path.string(), ": ", std::string(s.message())));
    }
    if (inputs.empty()) continue;
    const Tick first = inputs.front().tick;
    std::erase_if(out->inputs, [first](const LoggedInput& l) { return l.tick >= first; });
    std::move(inputs.begin(), inputs.end(), std::back_inserter(out->inputs));
  }
  std::erase_if(out->inputs, [out](const LoggedInput& l) { return l.tick <= out->checkpoint.tick; });
  if (absl::Status s = WriteAtomically(SegmentFile(0), EncodeInputs(out->inputs)); !s.ok()) return s;
  for (const auto& [incarnation, old] : found) {
    for (const auto& [number, path] : old) {
      if (path != SegmentFile(0)) std::filesystem::remove(path, error);
    }
  }
  return absl::OkStatus();
}

// Its inputs are those of segment 0.
void Journal::GoOnAfter(const Recovered& found) {
  const std::lock_guard lock(mutex_);
  if (!found.inputs.empty()) segments_.push_back({SegmentFile(0), found.inputs.back().tick});
  next_segment_ = 1;
}

std::filesystem::path Journal::SegmentFile(int64_t number) const {
  return directory_ / absl::StrCat(kLog, "-", incarnation_, "-", number);
}

absl::StatusOr<Journal::Recovered> Journal::Recover(uint64_t world_hash, RegionId region, const Least& least) {
  if (absl::Status s = TakeOver(least.incarnation); !s.ok()) return s;
  const absl::StatusOr<std::string> bytes = ReadAll(directory_ / kCheckpoint);
  if (!bytes.ok()) return bytes.status();
  absl::StatusOr<Checkpoint> checkpoint = DecodeCheckpoint(*bytes);
  if (!checkpoint.ok()) {
    return absl::DataLossError(
        absl::StrCat((directory_ / kCheckpoint).string(), ": ", std::string(checkpoint.status().message())));
  }
  if (checkpoint->world_hash != world_hash || checkpoint->region != region) {
    return absl::FailedPreconditionError(absl::StrFormat(
        "%s is of region %d of world %016x, not of region %d of world %016x", (directory_ / kCheckpoint).string(),
        checkpoint->region, checkpoint->world_hash, region, world_hash));
  }
  if (checkpoint->tick < least.tick) {
    return absl::FailedPreconditionError(absl::StrCat((directory_ / kCheckpoint).string(), " is of tick ",
                                                      checkpoint->tick, ", and what was not logged here is as late as ",
                                                      least.tick));
  }
  Recovered out{*std::move(checkpoint), {}};
  if (absl::Status s = ReadLog(&out); !s.ok()) return s;
  GoOnAfter(out);
  return out;
}

absl::Status Journal::Continue() {
  Recovered log;  // all of it: the checkpoint is not looked at
  absl::Status s = TakeOver(0);
  if (s.ok()) s = ReadLog(&log);
  if (absl::IsNotFound(s) || absl::IsDataLoss(s)) {
    log.inputs.clear();
    s = Renew();
  }
  if (s.ok()) GoOnAfter(log);
  return s;
}

absl::Status Journal::Clear() {
  std::error_code error;
  for (const auto& [incarnation, path] : Incarnations()) {
    if (incarnation > incarnation_) {
      return absl::AbortedError(absl::StrCat(path.string(), " is of a later incarnation than this, ", incarnation_));
    }
    std::filesystem::remove_all(path, error);
  }
  return SyncDirectory(root_);
}

// An empty directory of this incarnation, and no other.
absl::Status Journal::Renew() {
  if (absl::Status s = Clear(); !s.ok()) return s;
  std::error_code error;
  if (!std::filesystem::create_directory(directory_, error)) {
    return absl::UnavailableError(absl::StrCat("cannot make ", directory_.string(), ": ", error.message()));
  }
  return SyncDirectory(root_);
}

absl::Status Journal::Begin(const Checkpoint& first) {
  if (absl::Status s = Renew(); !s.ok()) return s;
  return Store(EncodeCheckpoint(first));
}

// The checkpoint comes last: without it, nothing is here.
absl::Status Journal::Adopt(const Recovered& found) {
  if (absl::Status s = Renew(); !s.ok()) return s;
  if (absl::Status s = WriteAtomically(SegmentFile(0), EncodeInputs(found.inputs)); !s.ok()) return s;
  GoOnAfter(found);
  return Store(EncodeCheckpoint(found.checkpoint));
}

void Journal::CopyTo(CopySender* copy) { copy_ = copy; }

absl::Status Journal::Store(const std::string& encoded) const {
  return WriteAtomically(directory_ / kCheckpoint, encoded);
}

void Journal::Log(Tick n, const std::vector<Input>& inputs) {
  std::string records;
  for (const Input& input : inputs) AppendRecord(n, input, &records);
  if (copy_ != nullptr) copy_->Log(n, records);
  LogRecords(n, std::move(records));
}

void Journal::LogRecords(Tick n, std::string records) {
  {
    const std::lock_guard lock(mutex_);
    if (std::exchange(new_segment_, false)) segments_.push_back({});
    segments_.back().last = logged_tick_ = n;
    records_ += records;
    ++logged_;
  }
  changed_.notify_all();
}

absl::Status Journal::AwaitLogged() {
  absl::Status out;
  {
    std::unique_lock lock(mutex_);
    changed_.wait(lock, [this] { return logged_durable_ == logged_; });
    out = std::exchange(log_status_, absl::OkStatus());
  }
  if (copy_ != nullptr) copy_->AwaitLogged();
  return out;
}

void Journal::WriteLog() {
  std::unique_lock lock(mutex_);
  for (;;) {
    changed_.wait(lock, [this] { return stopped_ || logged_durable_ != logged_; });
    if (logged_durable_ == logged_) return;
    const uint64_t upto = logged_;
    const Tick tick = logged_tick_;
    const std::string records = std::exchange(records_, {});
    const bool begin = segments_.back().path.empty();
    if (begin) segments_.back().path = SegmentFile(next_segment_++);
    const std::filesystem::path path = segments_.back().path;
    lock.unlock();
    absl::Status s;
    if (begin) {
      if (log_file_ >= 0) close(log_file_);
      log_file_ = open(path.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_APPEND | O_CLOEXEC, 0600);
      s = log_file_ < 0 ? FileError("write", path) : SyncDirectory(directory_);
    }
    if (s.ok()) s = WriteAll(log_file_, records, path);
    if (s.ok() && fdatasync(log_file_) != 0) s = FileError("sync", path);
    const bool taken_over = TakenOver();
    std::error_code error;
    if (taken_over) {
      s = absl::AbortedError(absl::StrCat(root_.string(), " was taken over by a later incarnation"));
    } else if (s.ok() && !std::filesystem::exists(path, error)) {
      s = absl::UnavailableError(absl::StrCat(path.string(), " is gone"));
    }
    lock.lock();
    logged_durable_ = upto;
    fenced_ |= taken_over;
    if (s.ok()) {
      stats_.logged_tick = tick;
    } else {
      log_status_ = s;
      stats_.least_tick = tick;
      Failed(s);
      new_segment_ = true;  // what is torn stays at the end of its file
    }
    Changed(&lock);
  }
}

// Gives the mutex away for a moment.
void Journal::Changed(std::unique_lock<std::mutex>* lock) {
  changed_.notify_all();
  if (told_ == nullptr) return;
  const Stats stats = stats_;
  lock->unlock();
  told_(stats);
  lock->lock();
}

bool Journal::writing() const {
  const std::lock_guard lock(mutex_);
  return writing_;
}

void Journal::Write(Checkpoint checkpoint, RegionId keeper) {
  if (copy_ != nullptr) copy_->Begin(checkpoint.tick, keeper);
  ToWrite next;
  next.tick = checkpoint.tick;
  next.used.emplace();
  for (const auto& [peer, link] : checkpoint.links) (*next.used)[peer] = {link.epoch, link.applied};
  next.checkpoint = std::move(checkpoint);
  WriteNext(std::move(next));
}

std::string Journal::TakeRoom() {
  const std::lock_guard lock(mutex_);
  return std::exchange(room_, {});
}

void Journal::WriteEncoded(Tick tick, std::string checkpoint) {
  ToWrite next;
  next.tick = tick;
  next.encoded = std::make_shared<const std::string>(std::move(checkpoint));
  WriteNext(std::move(next));
}

void Journal::WriteNext(ToWrite next) {
  {
    const std::lock_guard lock(mutex_);
    AUREOLE_CHECK(!writing_, "checkpoint of tick %lld while another is written", static_cast<long long>(next.tick));
    to_write_ = std::move(next);
    writing_ = true;
    new_segment_ = true;  // so that whole files are covered by it
  }
  changed_.notify_all();
}

void Journal::WriteCheckpoints() {
  std::unique_lock lock(mutex_);
  for (;;) {
    changed_.wait(lock, [this] { return stopped_ || to_write_.has_value(); });
    if (!to_write_.has_value()) return;
    ToWrite next = *std::exchange(to_write_, std::nullopt);
    lock.unlock();
    const auto began = std::chrono::steady_clock::now();
    if (next.checkpoint.has_value()) {
      next.encoded = std::make_shared<const std::string>(EncodeCheckpoint(*next.checkpoint));
      std::string room = std::move(next.checkpoint->state);
      next.checkpoint.reset();
      {
        const std::lock_guard again(mutex_);
        room_ = std::move(room);
      }
      if (copy_ != nullptr) copy_->Ship(next.tick, next.encoded);
    }
    const absl::Status s = Store(*next.encoded);
    const double ms = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - began).count();
    lock.lock();
    writing_ = false;
    if (s.ok()) {
      stats_.durable_tick = next.tick;
      ++stats_.checkpoints;
      stats_.bytes = static_cast<int64_t>(next.encoded->size());
      stats_.write_ms = ms;
      stats_.last_failure.clear();
      if (next.used.has_value()) durable_.emplace_back(next.tick, *std::move(next.used));
      DropSegments(next.tick);
    } else {
      fenced_ |= TakenOver();
      Failed(s);
    }
    next.encoded.reset();
    Changed(&lock);
  }
}

// Holds the mutex.
void Journal::Failed(const absl::Status& s) {
  ++stats_.failures;
  stats_.last_failure = std::string(s.message());
}

bool Journal::fenced() const {
  if (copy_ != nullptr && copy_->fenced()) return true;
  const std::lock_guard lock(mutex_);
  return fenced_;
}

// Holds the mutex.
void Journal::DropSegments(Tick durable) {
  while (segments_.size() > 1 && segments_.front().last <= durable) {
    std::error_code error;
    if (!segments_.front().path.empty()) std::filesystem::remove(segments_.front().path, error);
    segments_.pop_front();
  }
}

std::optional<Journal::Used> Journal::TakeDurable() {
  const std::lock_guard lock(mutex_);
  std::optional<Used> out;
  if (durable_.empty()) return out;
  const Tick newest = durable_.back().first;
  const Tick most = copy_ != nullptr ? copy_->MostToForget(newest) : newest;
  for (; !durable_.empty() && durable_.front().first <= most; durable_.pop_front()) {
    out = std::move(durable_.front().second);
  }
  return out;
}

bool Journal::durable(Tick tick) const {
  const Stats all = stats();
  return all.durable_tick >= tick && (!all.copy.covers || all.copy.tick >= tick);
}

Journal::Stats Journal::stats() const {
  const std::lock_guard lock(mutex_);
  Stats out = stats_;
  if (copy_ != nullptr) out.copy = copy_->stats();
  return out;
}

}  // namespace aureole
