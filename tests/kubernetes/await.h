// Waits for a condition instead of a time.
#pragma once

#include <chrono>
#include <functional>
#include <thread>

namespace aureole::kubernetes {

// False when it does not hold within 20 s, which is far more than it takes.
inline bool Await(const std::function<bool()>& condition) {
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(20);
  while (!condition()) {
    if (std::chrono::steady_clock::now() > end) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
  }
  return true;
}

}  // namespace aureole::kubernetes
