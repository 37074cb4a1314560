// What a region makes durable in a directory of its own, so that its next incarnation goes on bit for bit: the newest
// checkpoint, and every input that was offered here since, with its tick, before anybody hears of it.
//
// Two threads of its own write, so that a large checkpoint does not hold up the inputs. A file is either whole or not
// there: checkpoints are renamed into place, records of inputs carry a check sum, and a torn record at the end was
// never told to anybody.
//
// The incarnations of a region share a directory, in which each has one of its own, iN. The next one takes it over by
// renaming it, which fences the one before, should that still run: what it writes afterwards it cannot make durable, so
// that nobody hears of it, and it learns that it was fenced. The file system must be coherent between their machines.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <deque>
#include <filesystem>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/core/scene.h"
#include "server/region/checkpoint.h"

namespace aureole {

struct LoggedInput {
  Tick tick = 0;  // in which it is offered to the region: told with that tick's exchange
  Input input;
};

class Journal {
 public:
  struct Recovered {
    Checkpoint checkpoint;
    std::vector<LoggedInput> inputs;  // of the ticks after it, in the order in which they were logged
  };
  struct Stats {
    Tick durable_tick = 0;     // of the newest checkpoint
    int64_t checkpoints = 0;   // written
    int64_t bytes = 0;         // of the newest one
    double write_ms = 0;       // that it took, off the tick thread
    int64_t failures = 0;      // of checkpoints and of the log
    std::string last_failure;  // empty: the last thing that was written is durable
  };
  // What a durable checkpoint has used of each peer's frames: they need not be kept any more.
  using Used = std::map<RegionId, LinkMark>;

  // Makes the directory when it is missing. Unavailable: it cannot be made, or nothing can be written there.
  static absl::StatusOr<std::unique_ptr<Journal>> Open(const std::filesystem::path& directory, uint64_t incarnation);
  // Ends what is being written.
  ~Journal();
  Journal(const Journal&) = delete;
  Journal& operator=(const Journal&) = delete;

  // What the incarnation before has left, which is fenced. NotFound: no checkpoint. DataLoss: it, or the log, is
  // damaged. FailedPrecondition: of another world or region. Aborted: a later incarnation is here, or was.
  absl::StatusOr<Recovered> Recover(uint64_t world_hash, RegionId region);
  // Forgets what is here of all incarnations. Aborted: a later one is here.
  absl::Status Clear();
  // The same, and waits until the first checkpoint is durable.
  absl::Status Begin(const Checkpoint& first);

  // The tick thread. Starts to make inputs durable that will be offered in tick n; ticks do not descend.
  void Log(Tick n, const std::vector<Input>& inputs);
  // Waits until all that was logged is durable. Not OK: it could not be written, and is forgotten.
  absl::Status AwaitLogged();
  // A later incarnation has taken over: this one must not say anything any more.
  bool fenced() const;
  // Whether a checkpoint is still being written.
  bool writing() const;
  // Precondition: none is being written.
  void Write(Checkpoint checkpoint);
  // The newest that has become durable since the last call.
  std::optional<Used> TakeDurable();

  Stats stats() const;

 private:
  struct Segment {               // a file of the log
    std::filesystem::path path;  // empty: not made yet
    Tick last = 0;               // the last tick in it
  };

  Journal(std::filesystem::path root, uint64_t incarnation);
  std::map<uint64_t, std::filesystem::path> Incarnations() const;
  bool TakenOver() const;
  absl::Status TakeOver();
  absl::Status ReadLog(Recovered* out) const;
  void WriteCheckpoints();
  void WriteLog();
  absl::Status Append(const std::string& bytes);
  absl::Status Store(const Checkpoint& checkpoint, size_t* bytes) const;
  void Failed(const absl::Status& s);
  void DropSegments(Tick durable);
  std::filesystem::path SegmentFile(int64_t number) const;

  const std::filesystem::path root_, directory_;
  const uint64_t incarnation_;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  bool stopped_ = false;
  std::optional<Checkpoint> to_write_;
  bool writing_ = false;
  std::optional<Used> durable_;
  std::string records_;  // not yet written
  uint64_t logged_ = 0, logged_durable_ = 0;
  absl::Status log_status_;
  std::deque<Segment> segments_;  // the last one is being written
  bool new_segment_ = true;
  int64_t next_segment_ = 0;
  bool fenced_ = false;
  Stats stats_;

  int log_file_ = -1;  // of the log thread
  std::thread checkpoint_thread_, log_thread_;
};

}  // namespace aureole
