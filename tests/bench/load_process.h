// `aureole load` while it lives.
#pragma once

#include <sys/types.h>

#include <string>
#include <vector>

namespace aureole {

class LoadProcess {
 public:
  // `program`: aureole. What it prints goes into the file `out` (empty: nowhere).
  LoadProcess(const std::string& program, const std::string& server, int clients, const std::string& duration,
              const std::string& out = "");
  // Interrupts it, and waits.
  ~LoadProcess();

  void Signal(int signal) const;
  // Waits until it has ended by itself.
  void Wait();

 private:
  pid_t pid_ = -1;
};

}  // namespace aureole
