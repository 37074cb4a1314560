// How a program reaches a server: the channels of all calls of this library come from here.
#pragma once

#include <memory>
#include <string>

#include <grpcpp/channel.h>
#include <grpcpp/support/channel_arguments.h>

#include "aureole/client.h"

namespace aureole::client {

// With TLS where `access` has an authority, and with its token in every call. A token never goes in plain text to
// another machine: there, calls come without it, and are refused as such.
std::shared_ptr<grpc::Channel> ChannelTo(const std::string& endpoint, const Access& access,
                                         grpc::ChannelArguments arguments = {});

}  // namespace aureole::client
