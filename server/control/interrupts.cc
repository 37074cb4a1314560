#include "server/control/interrupts.h"

#include <signal.h>

#include <atomic>

namespace aureole {
namespace {

std::atomic<int> interrupts{0};
std::atomic<bool> terminated{false};
static_assert(std::atomic<int>::is_always_lock_free);  // used in a signal handler

void Count(int signal) {
  if (signal == SIGTERM) terminated = true;
  interrupts.fetch_add(1, std::memory_order_relaxed);
}

}  // namespace

void CatchInterrupts() {
  struct sigaction action = {};
  action.sa_handler = Count;
  action.sa_flags = SA_RESTART;
  for (const int number : {SIGINT, SIGTERM, SIGHUP}) sigaction(number, &action, nullptr);
  signal(SIGPIPE, SIG_IGN);
}

const std::atomic<bool>& Terminated() { return terminated; }

int Interrupts() { return interrupts.load(std::memory_order_relaxed); }

}  // namespace aureole
