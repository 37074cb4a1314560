// What a stream of replicas costs in bytes: all bodies moving, some, none; and the world of Fiedler's "Snapshot
// Compression".
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace aureole {

struct ClientBytesOptions {
  int bodies = 1000;
  int ticks = 600;  // of each scene, after the first second
};

struct ClientBytesRow {
  std::string scene, encoding;
  int period = 1;             // ticks between frames
  double moving = 0;          // mean share of bodies that changed from a frame to the next
  double bytes_per_body = 0;  // and frame
  double kbit_per_s = 0;
};

struct ClientBytesResult {
  std::vector<ClientBytesRow> rows;
  // Of the 901 cubes: over the seconds in which at most 4 % of the cubes moved, how many there were, and the largest
  // rate of one.
  int quiet_seconds = 0;
  double quiet_kbit_per_s = 0;
  uint64_t state_hash = 0;
};

ClientBytesResult MeasureClientBytes(const ClientBytesOptions& options);

}  // namespace aureole
