// Limits of the links between regions. A frame beyond one of them is refused, so that a broken or hostile peer cannot
// make a region allocate without bound; encoding such a frame is a broken invariant of the sender.
#pragma once

#include <cstddef>
#include <cstdint>

namespace aureole {

// Of the link protocol. Grows with every change that an older server would not understand.
inline constexpr uint32_t kPeerProtocolVersion = 7;

// Bytes of one message on the wire; more is refused by gRPC before it is read.
inline constexpr size_t kMaxMessageBytes = size_t{1} << 20;
// Bytes of frame in one message: a larger frame is cut into parts, so that an acknowledgement never waits behind more.
inline constexpr size_t kPartBytes = size_t{512} << 10;
// Bytes of one frame, all parts. The largest cluster that can move in one tick: about 100,000 bodies of 600 bytes.
inline constexpr size_t kMaxFrameBytes = size_t{64} << 20;

inline constexpr uint32_t kMaxRegions = 4096;
inline constexpr size_t kMaxAuras = size_t{1} << 20;  // a whole region told at once
inline constexpr size_t kMaxEdges = size_t{1} << 21;  // a few per told body
inline constexpr size_t kMaxFragments = size_t{1} << 19;
inline constexpr size_t kMaxTransfers = size_t{1} << 16;
inline constexpr size_t kMaxTransferBodies = size_t{1} << 17;  // of one cluster
inline constexpr size_t kMaxPending = size_t{1} << 16;         // announced spawns in one cluster
inline constexpr size_t kMaxInputs = size_t{1} << 12;          // of clients, told by one region in one tick
inline constexpr size_t kMaxApplied = size_t{1} << 20;         // of them, by one region in one tick

// A received frame is acknowledged at least this often, with the next frame that goes back or alone. Until then its
// sender keeps it: half a second of frames at three a tick.
inline constexpr uint64_t kAcknowledgeEvery = 64;

// Wait before dialling again, milliseconds; doubled up to the maximum, reset when a frame arrives.
inline constexpr int kMinBackoffMs = 50;
inline constexpr int kMaxBackoffMs = 1000;

// Seconds after which a silent connection is probed, and after which an unanswered probe ends it. Far above a server
// that is stopped for two seconds, which must not lose its links.
inline constexpr int kKeepaliveSeconds = 10;
inline constexpr int kKeepaliveTimeoutSeconds = 10;

inline constexpr size_t kMaxAuraBytes = 60;  // the bar of one aura update
static_assert(kPartBytes + 1024 <= kMaxMessageBytes, "a part and its header fit one message");
static_assert(kMaxAuras * kMaxAuraBytes <= kMaxFrameBytes, "the auras of a whole region fit one frame");

}  // namespace aureole
