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
//
// The same is kept by another region's server (copy_sender.h, copy_keeper.h), in a journal too, so that this directory
// may be lost.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <deque>
#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>
#include <thread>
#include <utility>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/core/scene.h"
#include "server/region/checkpoint.h"
#include "server/region/copy_sender.h"

namespace aureole {

struct LoggedInput {
  Tick tick = 0;  // in which it is offered to the region: told with that tick's exchange
  Input input;
};

// As the log has them.
std::string EncodeInputs(const std::vector<LoggedInput>& inputs);
// DataLoss when the bytes are not what EncodeInputs of this program wrote.
absl::StatusOr<std::vector<LoggedInput>> DecodeInputs(std::string_view bytes);

class Journal {
 public:
  struct Recovered {
    Checkpoint checkpoint;
    std::vector<LoggedInput> inputs;  // of the ticks after it, in the order in which they were logged
  };
  // What may be gone on from.
  struct Least {
    uint64_t incarnation = 0;  // no earlier one's
    Tick tick = 0;             // no older checkpoint
  };
  struct Stats {
    Tick durable_tick = 0;     // of the newest checkpoint
    Tick logged_tick = 0;      // the last of the inputs that were logged and did not fail
    int64_t checkpoints = 0;   // written
    int64_t bytes = 0;         // of the newest one
    double write_ms = 0;       // that it took, off the tick thread
    int64_t failures = 0;      // of checkpoints and of the log
    std::string last_failure;  // empty: the last thing that was written is durable
    Tick least_tick = 0;       // an older checkpoint here must not be gone on from: inputs of this tick are not logged
    CopySender::Stats copy;    // of an own one
  };
  // What a durable checkpoint has used of each peer's frames: they need not be kept any more.
  using Used = std::map<RegionId, LinkMark>;

  // Makes the directory when it is missing. Unavailable: it cannot be made, or nothing can be written there. `changed`
  // is told when something has become durable, or could not be written; on the journal's threads, so it must be quick
  // and not call the journal.
  static absl::StatusOr<std::unique_ptr<Journal>> Open(const std::filesystem::path& directory, uint64_t incarnation,
                                                       std::function<void(const Stats&)> changed = nullptr);
  // Ends what is being written.
  ~Journal();
  Journal(const Journal&) = delete;
  Journal& operator=(const Journal&) = delete;

  // What the incarnation before has left, which is fenced. NotFound: no checkpoint. DataLoss: it, or the log, is
  // damaged. FailedPrecondition: of another world or region, or stale: older than `least`. Aborted: a later incarnation
  // is here, or was.
  absl::StatusOr<Recovered> Recover(uint64_t world_hash, RegionId region, const Least& least);
  // Takes over what is here, whatever it is worth, to be replaced by the next checkpoint; what is logged from here on
  // is after it. Errors as of Recover, but that nothing or damage is none.
  absl::Status Continue();
  // Forgets what is here of all incarnations. Aborted: a later one is here.
  absl::Status Clear();
  // The same, and waits until the first checkpoint is durable.
  absl::Status Begin(const Checkpoint& first);
  // The same with what was recovered elsewhere: this incarnation goes on from it.
  absl::Status Adopt(const Recovered& found);
  // From here on all that becomes durable is copied too. Before anything is logged; the sender outlives the journal.
  void CopyTo(CopySender* copy);

  // The tick thread. Starts to make inputs durable that will be offered in tick n; ticks do not descend.
  void Log(Tick n, const std::vector<Input>& inputs);
  // The same, as EncodeInputs has them; nothing is copied.
  void LogRecords(Tick n, std::string records);
  // Waits until all that was logged is durable, here and, within its bounds, at the keeper. Not OK: it could not be
  // written here, and is forgotten.
  absl::Status AwaitLogged();
  // A later incarnation has taken over: this one must not say anything any more.
  bool fenced() const;
  // Whether a checkpoint is still being written.
  bool writing() const;
  // The memory of the last state that was written, for the next one.
  std::string TakeRoom();
  // Precondition: none is being written. `keeper`: where it is copied to from here on.
  void Write(Checkpoint checkpoint, RegionId keeper = kNoRegion);
  // The same, as EncodeCheckpoint has it; nothing is copied.
  void WriteEncoded(Tick tick, std::string checkpoint);
  // The newest since the last call that is durable here and, unless there is no whole copy, at the keeper: frames that
  // it has used are needed by no next incarnation.
  std::optional<Used> TakeDurable();
  // Whether there is such a checkpoint of this tick or later.
  bool durable(Tick tick) const;

  Stats stats() const;

 private:
  struct Segment {               // a file of the log
    std::filesystem::path path;  // empty: not made yet
    Tick last = 0;               // the last tick in it
  };

  struct ToWrite {
    Tick tick = 0;
    std::optional<Checkpoint> checkpoint;        // or
    std::shared_ptr<const std::string> encoded;  // what another server's checkpoint became
    std::optional<Used> used;                    // of an own one
  };

  Journal(std::filesystem::path root, uint64_t incarnation, std::function<void(const Stats&)> changed);
  std::map<uint64_t, std::filesystem::path> Incarnations() const;
  bool TakenOver() const;
  absl::Status TakeOver(uint64_t least);
  absl::Status Renew();
  absl::Status ReadLog(Recovered* out);
  void GoOnAfter(const Recovered& found);
  void WriteCheckpoints();
  void WriteLog();
  void WriteNext(ToWrite next);
  absl::Status Store(const std::string& encoded) const;
  void Failed(const absl::Status& s);
  void Changed(std::unique_lock<std::mutex>* lock);
  void DropSegments(Tick durable);
  std::filesystem::path SegmentFile(int64_t number) const;

  const std::filesystem::path root_, directory_;
  const uint64_t incarnation_;
  const std::function<void(const Stats&)> told_;
  CopySender* copy_ = nullptr;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  bool stopped_ = false;
  std::optional<ToWrite> to_write_;
  bool writing_ = false;
  std::string room_;
  std::deque<std::pair<Tick, Used>> durable_;  // that were not taken
  std::string records_;                        // not yet written
  Tick logged_tick_ = 0;
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
