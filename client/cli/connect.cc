#include "client/cli/connect.h"

#include <iostream>

#include "client/cli/exit_codes.h"

namespace aureole {

void AddServer(CLI::App* command, std::string* server) {
  command->add_option("--server", *server, "Any region server of the world; aureole up names them")
      ->required()
      ->type_name("HOST:PORT");
}

CLI::Option* AddVector(CLI::App* command, const std::string& name, std::vector<double>* out, const std::string& help) {
  return command->add_option(name, *out, help)->delimiter(',')->expected(3)->type_name("X,Y,Z");
}

client::Vec3 VectorOf(const std::vector<double>& v) {
  return v.size() == 3 ? client::Vec3{v[0], v[1], v[2]} : client::Vec3{};
}

std::unique_ptr<client::Client> ConnectTo(const std::string& server) {
  std::unique_ptr<client::Client> out;
  const client::Status s = client::Client::Connect(server, &out);
  if (!s.ok()) std::cerr << "--server " << server << ": no region server answers there (" << s.message << ")\n";
  return out;
}

int Report(const client::Status& status) {
  if (status.ok()) return kExitOk;
  std::cerr << "aureole: " << status.message << '\n';
  constexpr int kInvalidArgument = 3;
  return status.code == kInvalidArgument ? kExitBadInput : kExitFailed;
}

}  // namespace aureole
