// How long to wait before trying again, and a wait that ends early when asked to.
#pragma once

#include <chrono>
#include <random>
#include <stop_token>

namespace aureole::kubernetes {

// The n-th pause is between half and all of `first` * 2^n, at most `most`: many clients of one server that failed do
// not come back together.
class Backoff {
 public:
  using Duration = std::chrono::milliseconds;

  Backoff(Duration first, Duration most, uint64_t seed = std::random_device()());
  Duration Next();
  void Reset() { next_ = first_; }

 private:
  const Duration first_, most_;
  Duration next_;
  std::mt19937_64 random_;
};

// False when a stop was asked for before `pause` had passed; then at once.
bool Pause(const std::stop_token& stop, std::chrono::milliseconds pause);

}  // namespace aureole::kubernetes
