// What every command of `aureole` exits with.
#pragma once

namespace aureole {

inline constexpr int kExitOk = 0;
inline constexpr int kExitFailed = 1;         // the run failed, or was not exact
inline constexpr int kExitBadInput = 2;       // nothing was started
inline constexpr int kExitInterrupted = 130;  // before the end that was asked for

inline constexpr char kExitCodesHelp[] =
    "Exit codes: 0 fine; 1 the run failed or was not exact; 2 bad input, nothing was started;\n"
    "130 interrupted before its end.";

}  // namespace aureole
