// Where the servers of several worlds join, at one port: finds the run of a call by its metadata.
#pragma once

#include <map>
#include <mutex>
#include <string>

#include "aureole/v1/control.grpc.pb.h"

namespace aureole {

class ControlService;

// Of a call to Control.Join: which world the server is for.
inline constexpr char kWorldMetadata[] = "aureole-world";

// Thread-safe; no call blocks. Outlives the gRPC server that it is registered with, and the runs that add themselves.
class ControlHub final : public v1::Control::CallbackService {
 public:
  // From here on servers of this world join there.
  void Add(const std::string& world, ControlService* service);
  // From here on none does: those that ask are told to come again (Unavailable).
  void Remove(const std::string& world);

  grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion>* Join(grpc::CallbackServerContext* context) override;

 private:
  std::mutex mutex_;
  std::map<std::string, ControlService*> worlds_;
};

}  // namespace aureole
