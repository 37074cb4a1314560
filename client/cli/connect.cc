#include "client/cli/connect.h"

#include <cstdlib>
#include <fstream>
#include <iostream>
#include <sstream>

#include <absl/strings/ascii.h>

#include "client/cli/exit_codes.h"

namespace aureole {
namespace {

// Of the command line, whose options are parsed once.
client::Access& Parsed() {
  static client::Access access;
  return access;
}

std::string ReadOption(const std::string& option, const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::ostringstream text;
  if (!file || !(text << file.rdbuf())) throw CLI::ValidationError(option, path + " cannot be read, or is empty");
  return text.str();
}

}  // namespace

void AddServer(CLI::App* command, std::string* server) {
  command->add_option("--server", *server, "Any region server of the world; aureole up names them")
      ->required()
      ->type_name("HOST:PORT");
  AddAccess(command);
}

void AddAccess(CLI::App* command) {
  command
      ->add_option_function<std::string>(
          "--tls-ca", [](const std::string& path) { Parsed().tls_ca = ReadOption("--tls-ca", path); },
          "Authority of the servers' certificates, PEM; plain text when not given")
      ->envname("AUREOLE_TLS_CA")
      ->type_name("FILE");
  command
      ->add_option_function<std::string>(
          "--token-file",
          [](const std::string& path) {
            Parsed().token = std::string(absl::StripAsciiWhitespace(ReadOption("--token-file", path)));
          },
          "The token for this world; that of AUREOLE_TOKEN when not given")
      ->type_name("FILE");
}

client::Access GivenAccess() {
  client::Access out = Parsed();
  const char* const token = std::getenv("AUREOLE_TOKEN");
  if (out.token.empty() && token != nullptr) out.token = token;
  return out;
}

CLI::Option* AddVector(CLI::App* command, const std::string& name, std::vector<double>* out, const std::string& help) {
  return command->add_option(name, *out, help)->delimiter(',')->expected(3)->type_name("X,Y,Z");
}

client::Vec3 VectorOf(const std::vector<double>& v) {
  return v.size() == 3 ? client::Vec3{v[0], v[1], v[2]} : client::Vec3{};
}

std::unique_ptr<client::Client> ConnectTo(const std::string& server) {
  std::unique_ptr<client::Client> out;
  const client::Status s = client::Client::Connect(server, &out, 5, GivenAccess());
  if (s.ok()) return out;
  if (s.reason.empty()) {
    std::cerr << "--server " << server << ": no region server answers there (" << s.message << ')'
              << (GivenAccess().tls_ca.empty() ? "; is it one with TLS? then give --tls-ca"
                                               : "; is --tls-ca its authority?")
              << '\n';
  } else {
    std::cerr << "--server " << server << ": " << s.message << '\n';
  }
  return out;
}

int Report(const client::Status& status) {
  if (status.ok()) return kExitOk;
  std::cerr << "aureole: " << status.message << '\n';
  constexpr int kInvalidArgument = 3;
  return status.code == kInvalidArgument ? kExitBadInput : kExitFailed;
}

}  // namespace aureole
