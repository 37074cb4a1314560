// Prometheus metrics of a control plane, served as text over HTTP at /metrics. What worlds do is told by their servers.
#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include <absl/status/statusor.h>

#include "server/control/kubernetes/api_client.h"

namespace aureole::kubernetes {

class ControlMetrics {
 public:
  // Listens on `address`, host:port; port 0 is any. Unavailable when that is not possible.
  static absl::StatusOr<std::unique_ptr<ControlMetrics>> Serve(const std::string& address);
  ~ControlMetrics();

  int port() const;
  // One thread. `epoch`: 0 when it does not lead.
  void Update(int64_t epoch, size_t worlds, const ApiStats& api);

 private:
  struct Impl;
  explicit ControlMetrics(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace aureole::kubernetes
