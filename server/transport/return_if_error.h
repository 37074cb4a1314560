// For functions that return absl::Status.
#pragma once

#define AUREOLE_RETURN_IF_ERROR(expression)               \
  do {                                                    \
    if (absl::Status s = (expression); !s.ok()) return s; \
  } while (false)
