// The one place through which every call of our services comes before its handler runs, and before its request is read:
// who calls, and whether he may. Health and reflection, which are not ours, are open.
//
// An interceptor of gRPC 1.51 sees a call, but cannot end it in place of the handler, so what a Guard registers are not
// the services but their methods, each behind a door.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include <grpcpp/server_builder.h>
#include <grpcpp/server_context.h>

#include "aureole/v1/token.pb.h"
#include "server/transport/token_file.h"

namespace aureole {

// What a method wants of its caller: the right of a token, or to be a server, which no token can give.
struct Access {
  bool server = false;
  v1::Token::Right right = v1::Token::UNKNOWN;
};

// Of every method of our services, by its full name, aureole.v1.Simulation.GetWorld.
const std::map<std::string, Access>& MethodAccess();

// A set of rights.
class Rights {
 public:
  static Rights All() { return Rights(~0u); }
  explicit Rights(const v1::Token& token);
  bool Has(v1::Token::Right right) const { return (bits_ >> right & 1) != 0; }

 private:
  explicit Rights(unsigned bits) : bits_(bits) {}
  unsigned bits_ = 0;
};

// Those of the caller. Only within the method of a service that handles the call, for as long as it has not returned; a
// call that goes on keeps a copy. All, where no Guard stands before the service.
Rights RightsOfCaller();

// PERMISSION_DENIED, NO_RIGHT; `field`: what needs it, may be empty.
grpc::Status NoRight(const std::string& field, v1::Token::Right right);

// Thread-safe. Outlives the server.
class Guard {
 public:
  // `authorities`: the PEM file of those whose certificates make servers, read with each call of a server; empty, in
  // plain text: every caller without a token may be a server. `tokens` null: clients need none.
  Guard(std::string authorities, std::unique_ptr<TokenFile> tokens);
  ~Guard();
  Guard(const Guard&) = delete;
  Guard& operator=(const Guard&) = delete;

  // Registers the service, all of whose methods are of the callback API and in MethodAccess, behind this guard. Its
  // full name is the generated class's service_full_name().
  void Register(grpc::ServerBuilder* builder, const char* full_name, grpc::Service* service);
  // The world that tokens must be for. Until it is known they open nothing (UNAVAILABLE).
  void ServeWorld(const std::string& world);
  // Where several worlds are served: which one a call is for, or its refusal. `known`: the world that the caller's
  // token is for; of others he need not hear. Any thread.
  using WorldOf =
      std::function<grpc::Status(const grpc::ServerContextBase& context, const std::string& known, std::string* world)>;
  void ServeWorlds(WorldOf world_of);

  // Whether the call may go on; if so, `rights` are the caller's. The refusals are those of proto/README.md.
  grpc::Status Admit(const Access& access, const grpc::ServerContextBase& context, Rights* rights);

 private:
  class Service;

  grpc::Status AdmitServer(const grpc::ServerContextBase& context) const;
  grpc::Status AdmitToken(v1::Token::Right right, const std::string& token, const grpc::ServerContextBase& context,
                          Rights* rights);

  const std::string authorities_;
  const std::unique_ptr<TokenFile> tokens_;
  std::vector<std::unique_ptr<grpc::Service>> services_;
  std::mutex mutex_;
  WorldOf world_of_;  // null: not known yet
};

}  // namespace aureole
