// The copies that this server keeps for regions of others: a Journal for each, in DIRECTORY/region-N, and what is asked
// of it (proto/aureole/v1/copy.proto). Files are read and written on threads of its own.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <deque>
#include <filesystem>
#include <functional>
#include <map>
#include <mutex>
#include <thread>

#include <grpcpp/support/server_callback.h>

#include "aureole/v1/copy.grpc.pb.h"
#include "server/region/journal.h"

namespace aureole {

class CopyKeeper final : public v1::Copies::CallbackService {
 public:
  // Empty: this server keeps none. Made when the first copy comes, but not what it is in. What is there can be fetched
  // at once.
  explicit CopyKeeper(std::filesystem::path directory);
  // After the gRPC server.
  ~CopyKeeper() override;
  CopyKeeper(const CopyKeeper&) = delete;
  CopyKeeper& operator=(const CopyKeeper&) = delete;

  // From here on copies of this world are taken, as the server of this region.
  void Serve(uint64_t world_hash, RegionId self);

  grpc::ServerBidiReactor<v1::KeepMessage, v1::Kept>* Keep(grpc::CallbackServerContext* context) override;
  grpc::ServerWriteReactor<v1::CopyPart>* Fetch(grpc::CallbackServerContext* context,
                                                const v1::CopyOf* request) override;

 private:
  class Stream;
  class Reply;

  void Do(std::function<void()> work);
  void Work();
  // Below: within Do.
  absl::Status Check(const v1::CopyOf& of, bool keep);
  absl::Status Admit(Stream* stream, const v1::CopyOf& of);
  absl::StatusOr<Journal::Recovered> Take(const v1::CopyOf& of);
  void Fence(RegionId region, uint64_t incarnation);
  void Forget(Stream* stream);
  void Forget(Reply* reply);
  void Over();
  std::filesystem::path DirectoryOf(RegionId region) const;

  const std::filesystem::path directory_;
  std::map<RegionId, Stream*> streams_;  // of those that are kept now; within Do

  std::mutex mutex_;
  std::condition_variable changed_;
  bool serving_ = false, stopped_ = false;
  uint64_t world_hash_ = 0;
  RegionId self_ = kNoRegion;
  int calls_ = 0;  // alive
  std::deque<std::function<void()>> work_;
  std::thread thread_;
};

}  // namespace aureole
