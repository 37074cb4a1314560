// How one region server reaches another.
#pragma once

#include <memory>
#include <string>

#include <grpcpp/channel.h>
#include <grpcpp/security/credentials.h>

namespace aureole {

// With the limits, probes and waits of link_limits.h, over a connection of its own: what goes over one channel does not
// hold up what goes over another. Connects when it is used first.
std::shared_ptr<grpc::Channel> PeerChannel(const std::string& endpoint,
                                           const std::shared_ptr<grpc::ChannelCredentials>& credentials);

}  // namespace aureole
