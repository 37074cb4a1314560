// The state of bodies as bytes: what Engine::Save writes (EXACT.md L8). Little-endian; begins with a magic number and a
// version. Equal states give equal bytes. Contacts and joints need no more than what is here: contact points with their
// impulses in the order of Bullet's cache; no joint keeps anything between ticks (joints.h).
#pragma once

#include <span>
#include <string>
#include <string_view>

#include <absl/status/status.h>

#include "server/physics/bullet_world.h"

namespace aureole::physics {

// Precondition: `ids` ascend, are here, and are closed under joints and contacts; else the process stops.
void SaveState(const BulletWorld& world, std::span<const BodyId> ids, std::string* out);

// InvalidArgument names what is wrong; then nothing has changed.
absl::Status RestoreState(std::string_view bytes, BulletWorld* world);

}  // namespace aureole::physics
