// Inputs of clients to protobuf and back (proto/aureole/v1/input.proto). Lossless: every bit of a number survives.
#pragma once

#include <vector>

#include <absl/status/status.h>

#include "aureole/v1/input.pb.h"
#include "server/core/scene.h"

namespace aureole {

// Does not write the tick, nor the id of a spawned body: those that are told of it find them out. Bodies that share a
// shape are told it once, those that follow each other in the list.
void EncodeInputs(const std::vector<Input>& inputs, google::protobuf::RepeatedPtrField<v1::Input>* out);

// InvalidArgument names the field when it is no list that clients can have given and EncodeInputs have written.
absl::Status DecodeInputs(const google::protobuf::RepeatedPtrField<v1::Input>& in, std::vector<Input>* out);

// A change of the layout alone. That it is a layout, only LayoutOf says.
void EncodeLayoutChange(const LayoutChange& change, v1::LayoutChange* out);
absl::Status DecodeLayoutChange(const v1::LayoutChange& in, LayoutChange* out);

// With their ticks and the ids of spawned bodies, for recordings; shapes as EncodeInputs tells them.
void RecordInputs(const std::vector<Input>& inputs, google::protobuf::RepeatedPtrField<v1::Input>* out);
// Of one with its shape.
absl::Status ReadRecordedInput(const v1::Input& in, Input* out);

}  // namespace aureole
