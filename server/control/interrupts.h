// Ctrl-C and its relatives, as something that a loop can ask for.
#pragma once

#include <atomic>

namespace aureole {

// From now on SIGINT, SIGTERM and SIGHUP are counted instead of ending the process, and SIGPIPE is ignored. Of the
// whole process; call it once, at the start of main.
void CatchInterrupts();

// Becomes true with the first SIGTERM: what a supervisor sends to a process that is to be replaced, where Ctrl-C is a
// person who wants the end.
const std::atomic<bool>& Terminated();

// Signals counted so far. 0: go on; 1: stop in order; more: the user is impatient.
int Interrupts();

}  // namespace aureole
