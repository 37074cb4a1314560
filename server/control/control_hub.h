// The control planes of several worlds at one port: finds the run of a call by its metadata.
#pragma once

#include <map>
#include <memory>
#include <mutex>
#include <string>

#include "aureole/v1/control.grpc.pb.h"
#include "aureole/v1/control_plane.grpc.pb.h"

namespace aureole {

class ControlPlaneService;
class ControlService;

// Of a call to Control.Join: which world the server is for; of one to ControlPlane: which world it is about.
inline constexpr char kWorldMetadata[] = "aureole-world";

// Thread-safe; no call blocks. Outlives the gRPC server that its services are registered with, and the runs that add
// themselves.
class ControlHub final : public v1::Control::CallbackService {
 public:
  struct Run {
    ControlService* servers = nullptr;
    ControlPlaneService* operators = nullptr;  // null: nobody operates it
    std::string tokens_for;                    // the world that operators' tokens must be for
  };

  ControlHub();
  ~ControlHub() override;

  // From here on the servers of this world join there, and its operators call there.
  void Add(const std::string& world, const Run& run);
  // From here on none does: servers that ask are told to come again (Unavailable).
  void Remove(const std::string& world);

  grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion>* Join(grpc::CallbackServerContext* context) override;

  // Passes each call on to its world's. INVALID_ARGUMENT: the call names no world; NOT_FOUND: none that runs here; both
  // say which there are.
  v1::ControlPlane::CallbackService& operators();
  // For Guard::ServeWorlds: which world an operator's token must be for.
  grpc::Status TokensFor(const grpc::ServerContextBase& context, const std::string& known, std::string* world);

 private:
  class Operators;

  // With the mutex. OK: `run` is that of the call. `known`: a refusal names only worlds with such tokens; null: all.
  grpc::Status Find(const grpc::ServerContextBase& context, const std::string* known, const Run** run) const;

  std::mutex mutex_;
  std::map<std::string, Run> worlds_;
  const std::unique_ptr<Operators> operators_;
};

}  // namespace aureole
