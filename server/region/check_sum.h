// Of what is kept in files: damage is found, not repaired.
#pragma once

#include <zlib.h>

#include <cstdint>
#include <string_view>

namespace aureole {

inline uint32_t CheckSum(std::string_view bytes) {
  return static_cast<uint32_t>(crc32_z(0, reinterpret_cast<const Bytef*>(bytes.data()), bytes.size()));
}

}  // namespace aureole
