// What the commands have in common that talk to a running world.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "aureole/client.h"

namespace aureole {

// Adds --server HOST:PORT, required, and what AddAccess adds.
void AddServer(CLI::App* command, std::string* server);
// Adds --tls-ca FILE and --token-file FILE; the environment's AUREOLE_TLS_CA (a file) and AUREOLE_TOKEN (the token)
// stand for them.
void AddAccess(CLI::App* command);
// What they, or the environment, have given to the command that runs.
client::Access GivenAccess();
// Adds an option of three numbers, x,y,z.
CLI::Option* AddVector(CLI::App* command, const std::string& name, std::vector<double>* out, const std::string& help);
client::Vec3 VectorOf(const std::vector<double>& xyz);

// Null after a message on stderr when the server does not answer.
std::unique_ptr<client::Client> ConnectTo(const std::string& server);
// Says on stderr what went wrong, and returns an exit code.
int Report(const client::Status& status);

}  // namespace aureole
