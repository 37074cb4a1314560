// Bodies that fall into a pit of 9 m by 9 m and lie there in contact; nothing sleeps.
#pragma once

#include "server/core/world.h"

namespace aureole {

World HeapWorld(int bodies);

}  // namespace aureole
