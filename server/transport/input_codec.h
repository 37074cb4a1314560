// Inputs of clients to protobuf and back (proto/aureole/v1/input.proto). Lossless: every bit of a number survives.
#pragma once

#include <absl/status/status.h>

#include "aureole/v1/input.pb.h"
#include "server/core/scene.h"

namespace aureole {

// Does not write the tick, nor the id of a spawned body: those that are told of it find them out.
void EncodeInput(const Input& input, v1::Input* out);

// InvalidArgument names the field when it is not an input that a client can have given and EncodeInput have written.
absl::Status DecodeInput(const v1::Input& in, Input* out);

// With its tick and the id of a spawned body, for recordings.
void RecordInput(const Input& input, v1::Input* out);
absl::Status ReadRecordedInput(const v1::Input& in, Input* out);

}  // namespace aureole
