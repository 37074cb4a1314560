// A region server without a world: it speaks control.proto and makes up its reports. The hashes and bodies of all
// regions add up to the same world for every number of regions.
#pragma once

#include <atomic>
#include <memory>
#include <string>

#include <grpcpp/grpcpp.h>

#include "aureole/v1/control.grpc.pb.h"

namespace aureole {

struct FakeBehaviour {
  uint32_t protocol_version = 1;
  int64_t die_at = -1;   // tick; leaves without a word and Run returns 3
  int fail_region = -1;  // only this region does what follows; -1: all
  bool never_ready = false;
  bool ignore_stop = false;  // stays until it is cancelled
  bool wrong_hash = false;   // from tick 200 on
  int64_t lose_at = -1;      // tick; from then on one body is missing
  std::string goodbye;       // said at tick 10, with the end of the stream
};

inline constexpr int64_t kFakeBodies = 120;

class FakeRegion {
 public:
  FakeRegion(std::string control, std::string token, FakeBehaviour behaviour);
  // Blocks until Stop, the end of the stream or Cancel; returns what a process would exit with.
  int Run();
  // From any thread.
  void Cancel();

 private:
  void Simulate(const v1::Assignment& assignment);
  v1::Report MakeReport(const v1::Assignment& assignment, int64_t from, int64_t to) const;
  bool Misbehaves(const v1::Assignment& assignment) const;

  const std::string control_, token_;
  const FakeBehaviour behaviour_;
  grpc::ClientContext context_;
  std::unique_ptr<grpc::ClientReaderWriter<v1::FromRegion, v1::ToRegion>> stream_;
  std::atomic<bool> cancelled_ = false, stopped_ = false;
  std::atomic<int> exit_ = 0;
};

// The hash of the whole made-up world.
uint64_t FakeHash(int64_t tick);

}  // namespace aureole
