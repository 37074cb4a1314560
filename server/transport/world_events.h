// Joints, events and injectors of a WorldSpec. For the loader in world_spec.cc. All read after the bodies.
#pragma once

#include "server/core/world.h"
#include "server/transport/world_bodies.h"

namespace aureole {

// world->bodies and world->environment are complete.
void ReadJoints(const v1::WorldSpec& spec, SpecCheck* check, World* world);

// The same, and the tick; fills world->script. Bodies that events spawn get their ids from the reader.
void ReadEvents(const v1::WorldSpec& spec, BodyReader* reader, World* world);

void ReadInjectors(const v1::WorldSpec& spec, Catalogue* catalogue, SpecCheck* check, World* world);

}  // namespace aureole
