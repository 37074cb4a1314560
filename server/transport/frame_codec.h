// Frames to bytes and back (proto/aureole/v1/peer.proto). Lossless: every bit of a float survives.
#pragma once

#include <string>
#include <string_view>

#include <absl/status/statusor.h>

#include "server/core/frame.h"

namespace aureole {

// The serialised Frame message. Does not depend on `frame.from` and `frame.to`, so a broadcast is encoded once. A frame
// beyond link_limits.h is a broken invariant and stops the process. Of a pending spawn only tick and body are written:
// the script says the rest.
std::string EncodeFrame(const Frame& frame);

// The frame that `from` sent to `to`. InvalidArgument names the field when the bytes are not a frame that EncodeFrame
// can have made: syntax, counts that do not match, limits, ids of 0, boxes that are not finite or inside out, order.
absl::StatusOr<Frame> DecodeFrame(std::string_view bytes, RegionId from, RegionId to);

}  // namespace aureole
