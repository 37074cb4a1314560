#include "server/region/journal.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstring>
#include <fstream>
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
std::string RecordOf(Tick n, const Input& input) {
  std::string body, out;
  Writer writer(&body);
  writer(n, input);
  Writer head(&out);
  head(static_cast<uint32_t>(body.size()), CheckSum(body));
  return out + body;
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

Journal::Journal(std::filesystem::path root, uint64_t incarnation)
    : root_(std::move(root)), directory_(root_ / absl::StrCat("i", incarnation)), incarnation_(incarnation) {}

absl::StatusOr<std::unique_ptr<Journal>> Journal::Open(const std::filesystem::path& directory, uint64_t incarnation) {
  std::error_code error;
  std::filesystem::create_directories(directory, error);
  if (error) return absl::UnavailableError(absl::StrCat("cannot make ", directory.string(), ": ", error.message()));
  if (absl::Status s = WriteAtomically(directory / "writable", ""); !s.ok()) return s;
  std::unique_ptr<Journal> out(new Journal(directory, incarnation));
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

absl::Status Journal::TakeOver() {
  const std::map<uint64_t, std::filesystem::path> all = Incarnations();
  if (all.empty()) return absl::NotFoundError(absl::StrCat("no ", (root_ / "iN" / kCheckpoint).string()));
  const auto& [newest, path] = *all.rbegin();
  if (newest >= incarnation_) {
    return absl::AbortedError(
        absl::StrCat(path.string(), " is not of an earlier incarnation than this, ", incarnation_));
  }
  if (std::rename(path.c_str(), directory_.c_str()) != 0) return FileError("rename", path);
  return SyncDirectory(root_);
}

// The segments of the latest incarnation that has any hold all that is needed. They are put together in one of this
// incarnation, since a fenced one may still write to those it has open.
absl::Status Journal::ReadLog(Recovered* out) const {
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
    if (absl::Status s = ReadRecords(*records, number == files.rbegin()->first, &out->inputs); !s.ok()) {
      return absl::DataLossError(absl::StrCat(path.string(), ": ", std::string(s.message())));
    }
  }
  std::erase_if(out->inputs, [out](const LoggedInput& l) { return l.tick <= out->checkpoint.tick; });
  std::string all;
  for (const LoggedInput& l : out->inputs) all += RecordOf(l.tick, l.input);
  if (absl::Status s = WriteAtomically(SegmentFile(0), all); !s.ok()) return s;
  for (const auto& [incarnation, old] : found) {
    if (incarnation == incarnation_) continue;
    for (const auto& [number, path] : old) std::filesystem::remove(path, error);
  }
  return absl::OkStatus();
}

std::filesystem::path Journal::SegmentFile(int64_t number) const {
  return directory_ / absl::StrCat(kLog, "-", incarnation_, "-", number);
}

absl::StatusOr<Journal::Recovered> Journal::Recover(uint64_t world_hash, RegionId region) {
  if (absl::Status s = TakeOver(); !s.ok()) return s;
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
  Recovered out{*std::move(checkpoint), {}};
  if (absl::Status s = ReadLog(&out); !s.ok()) return s;
  const std::lock_guard lock(mutex_);
  if (!out.inputs.empty()) segments_.push_back({SegmentFile(0), out.inputs.back().tick});
  next_segment_ = 1;
  return out;
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

absl::Status Journal::Begin(const Checkpoint& first) {
  if (absl::Status s = Clear(); !s.ok()) return s;
  std::error_code error;
  if (!std::filesystem::create_directory(directory_, error)) {
    return absl::UnavailableError(absl::StrCat("cannot make ", directory_.string(), ": ", error.message()));
  }
  if (absl::Status s = SyncDirectory(root_); !s.ok()) return s;
  size_t bytes = 0;
  return Store(first, &bytes);
}

absl::Status Journal::Store(const Checkpoint& checkpoint, size_t* bytes) const {
  const std::string encoded = EncodeCheckpoint(checkpoint);
  *bytes = encoded.size();
  return WriteAtomically(directory_ / kCheckpoint, encoded);
}

void Journal::Log(Tick n, const std::vector<Input>& inputs) {
  std::string records;
  for (const Input& input : inputs) records += RecordOf(n, input);
  {
    const std::lock_guard lock(mutex_);
    if (std::exchange(new_segment_, false)) segments_.push_back({});
    segments_.back().last = n;
    records_ += records;
    ++logged_;
  }
  changed_.notify_all();
}

absl::Status Journal::AwaitLogged() {
  std::unique_lock lock(mutex_);
  changed_.wait(lock, [this] { return logged_durable_ == logged_; });
  return std::exchange(log_status_, absl::OkStatus());
}

void Journal::WriteLog() {
  std::unique_lock lock(mutex_);
  for (;;) {
    changed_.wait(lock, [this] { return stopped_ || logged_durable_ != logged_; });
    if (logged_durable_ == logged_) return;
    const uint64_t upto = logged_;
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
    if (taken_over) s = absl::AbortedError(absl::StrCat(root_.string(), " was taken over by a later incarnation"));
    lock.lock();
    logged_durable_ = upto;
    fenced_ |= taken_over;
    if (!s.ok()) {
      log_status_ = s;
      Failed(s);
      new_segment_ = true;  // what is torn stays at the end of its file
    }
    changed_.notify_all();
  }
}

bool Journal::writing() const {
  const std::lock_guard lock(mutex_);
  return writing_;
}

void Journal::Write(Checkpoint checkpoint) {
  {
    const std::lock_guard lock(mutex_);
    AUREOLE_CHECK(!writing_, "checkpoint of tick %lld while another is written",
                  static_cast<long long>(checkpoint.tick));
    to_write_ = std::move(checkpoint);
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
    const Checkpoint checkpoint = *std::exchange(to_write_, std::nullopt);
    lock.unlock();
    const auto began = std::chrono::steady_clock::now();
    size_t bytes = 0;
    const absl::Status s = Store(checkpoint, &bytes);
    const double ms = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - began).count();
    lock.lock();
    writing_ = false;
    if (s.ok()) {
      stats_.durable_tick = checkpoint.tick;
      ++stats_.checkpoints;
      stats_.bytes = static_cast<int64_t>(bytes);
      stats_.write_ms = ms;
      stats_.last_failure.clear();
      Used used;
      for (const auto& [peer, link] : checkpoint.links) used[peer] = {link.epoch, link.applied};
      durable_ = std::move(used);
      DropSegments(checkpoint.tick);
    } else {
      fenced_ |= TakenOver();
      Failed(s);
    }
    changed_.notify_all();
  }
}

// Holds the mutex.
void Journal::Failed(const absl::Status& s) {
  ++stats_.failures;
  stats_.last_failure = std::string(s.message());
}

bool Journal::fenced() const {
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
  return std::exchange(durable_, std::nullopt);
}

Journal::Stats Journal::stats() const {
  const std::lock_guard lock(mutex_);
  return stats_;
}

}  // namespace aureole
