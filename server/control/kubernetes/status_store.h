// Writes the status of one World: the record that the next control plane needs, at once, and what people want to see,
// at most once a second and only what has changed. All with optimistic concurrency, on a thread of its own.
#pragma once

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <optional>
#include <stop_token>
#include <string>
#include <thread>

#include <absl/status/status.h>
#include <absl/status/statusor.h>

#include "server/control/kubernetes/api_client.h"
#include "server/control/kubernetes/world_status.h"
#include "server/control/world_store.h"

namespace aureole::kubernetes {

// Load and Save as WorldStore says, and besides: Save waits for the API server for as long as we lead; Cancelled after
// Close. Aborted also when the World is gone, or when we lead no more. InvalidArgument: the record is refused, by the
// schema or for its size. A status that is refused for its other fields is told of and tried again, more and more
// seldom; the record goes without them.
class StatusStore final : public WorldStore {
 public:
  struct Options {
    std::string space, name, uid;  // of the World
    int64_t epoch = 1;             // of this control plane: status.controlEpoch; a higher one there has the world
    std::function<bool()> leads = [] { return true; };                // asked before every write; any thread
    std::chrono::milliseconds interval{1000};                         // between two writes without a record, at least
    std::chrono::milliseconds first_pause{100}, longest_pause{5000};  // after failures
    std::chrono::milliseconds first_refusal{1000}, longest_refusal{60000};        // after refusals: pauses
    std::function<void(const std::string&)> refused = [](const std::string&) {};  // why; on the store's thread
  };

  // `client` must outlive it.
  StatusStore(ApiClient* client, Options options);
  // Closes.
  ~StatusStore() override;
  StatusStore(const StatusStore&) = delete;
  StatusStore& operator=(const StatusStore&) = delete;

  absl::StatusOr<std::optional<v1::WorldRecord>> Load() override;
  absl::Status Save(const v1::WorldRecord& record) override;
  // A world that is begun anew has none. As Save.
  absl::Status Forget();

  // As last read or written.
  Json there() const;
  // Any thread, returns at once: is written when it can be. Fields that are not named stay as they were.
  void Publish(const WorldStatus& status);
  // Waits until all is written; false when that takes longer.
  bool Flush(std::chrono::milliseconds at_most);
  // From now on nothing is written or waited for. Idempotent, any thread.
  void Close();

 private:
  using Clock = std::chrono::steady_clock;

  void Run(const std::stop_token& stop);
  enum class What : uint8_t { kAll, kRecord };
  absl::Status Write(What what, const std::stop_token& stop);
  absl::Status Read(const std::stop_token& stop);
  absl::Status SaveText(Json record);
  // Holds the mutex: what is there is not yet what is wanted.
  Json Missing(What what, const std::string& now) const;

  ApiClient* const client_;
  const Options options_;
  const Resource worlds_, statuses_;

  mutable std::mutex mutex_;
  std::condition_variable_any changed_;
  Json there_ = Json::object();  // the status as last read or written
  std::string version_;          // of the World; empty: read first
  WorldStatus wanted_;
  std::optional<Json> record_;  // to be written; null: to be removed
  bool dirty_ = false, writing_ = false, closed_ = false;
  absl::Status lost_;            // Aborted: nothing can be written any more
  absl::Status record_refused_;  // InvalidArgument: of the last record
  std::jthread thread_;
};

}  // namespace aureole::kubernetes
