#pragma once

#include <string>

namespace aureole {

// Path of this executable, for tests that run it again in another mode.
const std::string& TestExecutable();

}  // namespace aureole
