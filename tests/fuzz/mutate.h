// Random changes of protobuf messages and of bytes, from a seed.
#pragma once

#include <string>

#include <google/protobuf/message.h>

#include "tests/simulation/random.h"

namespace aureole::fuzz {

// Sets, clears, repeats or drops a few fields, at any depth; numbers are often the ones that break things.
void Mutate(google::protobuf::Message* message, sim::Random* random);
// Changes, cuts or repeats a few bytes.
void Mutate(std::string* bytes, sim::Random* random);

}  // namespace aureole::fuzz
