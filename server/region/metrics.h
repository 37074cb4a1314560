// Prometheus metrics of a region server, served as text over HTTP at /metrics.
#pragma once

#include <memory>
#include <string>

#include <absl/status/statusor.h>

#include "aureole/v1/control.pb.h"
#include "server/core/region.h"
#include "server/region/frame_clock.h"

namespace aureole {

class RegionMetrics {
 public:
  // Listens on `address`, host:port; port 0 is any. Unavailable when that is not possible.
  static absl::StatusOr<std::unique_ptr<RegionMetrics>> Serve(const std::string& address);
  ~RegionMetrics();

  // host:port that it listens on.
  const std::string& endpoint() const;

  // Thread-safe.
  void Assigned(const std::string& world, RegionId region);
  void AddTick(const FrameSample& sample);
  void Update(const v1::Report& report);
  // Handshakes that were refused so far, both as caller and as called.
  void UpdateRefusedLinks(int64_t total);

 private:
  struct Impl;
  explicit RegionMetrics(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace aureole
