#include "client/cli/token.h"

#include <iostream>

#include "client/cli/exit_codes.h"
#include "server/control/issue_token.h"

namespace aureole {

CLI::App* AddToken(CLI::App& app, TokenOptions* o) {
  CLI::App* c = app.add_subcommand("token", "Let somebody call a world: prints a new token, once");
  c->add_option("name", o->name, "Whose it is")->required();
  c->add_option("--world", o->world, "The name of the world that it opens, as its file says")->required();
  c->add_option("--rights", o->rights, "Of watch, push, spawn (and remove) and operate (record)")
      ->delimiter(',')
      ->required()
      ->type_name("RIGHT,...");
  c->add_option("--tokens", o->tokens, "The servers' file, which is made when missing")->required()->type_name("FILE");
  c->add_option("--days", o->days, "How long it holds; for ever when not given")->check(CLI::Range(1, 36500));
  c->footer(
      std::string(
          "Example:\n"
          "  aureole token anna --world demo --rights watch,push --tokens tokens.json > anna.token\n"
          "  aureole up tests/worlds/demo.json --tls certificates --tokens tokens.json\n"
          "  aureole watch --server 127.0.0.1:40001 --tls-ca certificates/ca.crt --token-file anna.token\n\n"
          "The file has only a hash of it. Servers read the file again within a second or so; to take a token back,\n"
          "remove its entry. Calls that are open go on.\n") +
      kExitCodesHelp);
  return c;
}

int RunToken(const TokenOptions& o) {
  TokenRequest request{o.name, o.world, o.rights, std::nullopt};
  if (o.days > 0) request.life = absl::Hours(24) * o.days;
  const absl::StatusOr<std::string> token = IssueToken(o.tokens, request);
  if (!token.ok()) {
    std::cerr << token.status().message() << '\n';
    return kExitBadInput;
  }
  std::cout << *token << '\n';
  return kExitOk;
}

}  // namespace aureole
