// A process that may lead, for tests that stop, freeze and kill it: elector SERVER CANDIDATE DURATION_MS DEADLINE_MS
// RETRY_MS. Answers each line of stdin with one of stdout: the epoch when it may act now, else "none".
#include <cstdlib>
#include <iostream>
#include <string>

#include "server/control/kubernetes/leader_elector.h"

int main(int argc, char** argv) {
  using namespace aureole::kubernetes;
  if (argc != 6) return 2;
  ClusterAccess access;
  access.server = argv[1];
  ApiClient client(access);
  Wakeup wakeup;
  const auto ms = [&](int i) { return std::chrono::milliseconds(std::atoi(argv[i])); };
  LeaderElector elector(&client, {"test", "leader", argv[2], {ms(3), ms(4), ms(5)}}, &wakeup);
  for (std::string line; std::getline(std::cin, line);) {
    const std::optional<int64_t> epoch = elector.Epoch();
    std::cout << (epoch ? std::to_string(*epoch) : "none") << std::endl;
  }
}
