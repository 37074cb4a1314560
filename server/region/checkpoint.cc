#include "server/region/checkpoint.h"

#include <utility>

#include <absl/strings/str_cat.h>

#include "server/core/archive.h"
#include "server/region/check_sum.h"

namespace aureole {

template <class Archive>
void Visit(Archive& a, LinkState& v) {
  a(v.epoch, v.applied, v.first, v.kept);
}

namespace {

constexpr uint64_t kMagic = 0x3354504b43524100;  // of this layout of the bytes

template <class Archive>
void VisitCheckpoint(Archive& a, Checkpoint& c) {
  a(c.world_hash, c.region, c.tick, c.state, c.links, c.hashes);
}

}  // namespace

Checkpoint TakeCheckpoint(uint64_t world_hash, const Region& region, const RegionLinks& links, std::string room) {
  room.clear();
  region.SaveTo(&room);
  Checkpoint out{world_hash, region.self(), region.tick(), std::move(room), links.States(), {}};
  for (RegionId peer : region.peers()) out.links.at(peer).applied = region.FramesTaken(peer);
  return out;
}

std::string EncodeCheckpoint(const Checkpoint& checkpoint) {
  std::string out;
  out.reserve(checkpoint.state.size() + (size_t{1} << 16));
  Writer writer(&out);
  writer(kMagic);
  VisitCheckpoint(writer, const_cast<Checkpoint&>(checkpoint));  // only read
  writer(CheckSum(out));
  return out;
}

absl::StatusOr<Checkpoint> DecodeCheckpoint(std::string_view bytes) {
  uint32_t sum = 0;
  uint64_t magic = 0;
  if (bytes.size() < sizeof magic + sizeof sum) {
    return absl::DataLossError(absl::StrCat("the checkpoint has only ", bytes.size(), " bytes"));
  }
  Reader tail(bytes.substr(bytes.size() - sizeof sum));
  tail(sum);
  bytes.remove_suffix(sizeof sum);
  if (sum != CheckSum(bytes)) return absl::DataLossError("the checkpoint's check sum is wrong");
  Reader reader(bytes);
  reader(magic);
  if (magic != kMagic) return absl::DataLossError("the checkpoint was written by another release");
  Checkpoint out;
  VisitCheckpoint(reader, out);
  if (!reader.done()) return absl::DataLossError("the checkpoint has parts that cannot be read");
  return out;
}

}  // namespace aureole
