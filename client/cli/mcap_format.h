// Numbers of the MCAP format (mcap.dev/spec) that its writer and its reader share.
#pragma once

#include <cstdint>
#include <string_view>

namespace aureole::mcap {

inline constexpr std::string_view kMagic("\x89MCAP0\r\n", 8);

enum Opcode : uint8_t {
  kHeader = 0x01,
  kFooter = 0x02,
  kSchema = 0x03,
  kChannel = 0x04,
  kMessage = 0x05,
  kChunk = 0x06,
  kMessageIndex = 0x07,
  kChunkIndex = 0x08,
  kStatistics = 0x0b,
  kSummaryOffset = 0x0e,
  kDataEnd = 0x0f,
};

}  // namespace aureole::mcap
