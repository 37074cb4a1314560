// Ctrl-C and its relatives, as something that a loop can ask for.
#pragma once

namespace aureole {

// From now on SIGINT, SIGTERM and SIGHUP are counted instead of ending the process, and SIGPIPE is ignored. Of the
// whole process; call it once, at the start of main.
void CatchInterrupts();

// Signals counted so far. 0: go on; 1: stop in order; more: the user is impatient.
int Interrupts();

}  // namespace aureole
