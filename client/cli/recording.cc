#include "client/cli/recording.h"

#include <absl/strings/str_cat.h>

#include "client/cli/mcap_reader.h"
#include "client/src/layout_follower.h"

namespace aureole {
namespace {

template <class Message>
absl::Status Parse(const McapMessage& from, Message* to) {
  if (to->ParseFromArray(from.data.data(), static_cast<int>(from.data.size()))) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("a message of ", std::string(from.topic), " is no ", Message::descriptor()->full_name()));
}

template <class Message>
bool Is(const McapMessage& message) {
  return message.type == Message::descriptor()->full_name();
}

}  // namespace

std::string RegionTopic(int region, const std::string& what) { return absl::StrCat("/region/", region, "/", what); }

absl::StatusOr<RecordedRun> ReadRecording(const std::string& path) {
  RecordedRun out;
  std::map<int64_t, size_t> told;  // regions, by tick
  const absl::Status read = ReadMcap(
      path,
      [&](const McapMessage& message) {
        if (Is<v1::GetWorldResponse>(message)) return Parse(message, &out.world.emplace());
        if (Is<v1::Snapshot>(message)) return Parse(message, &out.snapshots.emplace_back());
        if (Is<v1::Input>(message)) return Parse(message, &out.inputs.emplace_back());
        if (!Is<v1::StateHashes>(message)) return absl::OkStatus();
        v1::StateHashes hashes;
        if (absl::Status s = Parse(message, &hashes); !s.ok()) return s;
        if (hashes.body_size() != hashes.hash_size()) {
          return absl::InvalidArgumentError(
              absl::StrCat("the hashes of tick ", hashes.tick(), " are not one per body"));
        }
        // Bodies are elsewhere by then.
        if (out.world.has_value() && hashes.layout_epoch() > out.world->layout_epoch()) return absl::OkStatus();
        ++told[hashes.tick()];
        uint64_t body = 0;
        for (int i = 0; i < hashes.body_size(); ++i) out.hashes[hashes.tick()][body += hashes.body(i)] = hashes.hash(i);
        return absl::OkStatus();
      },
      &out.whole);
  if (!read.ok()) return read;
  if (!out.world.has_value()) return absl::InvalidArgumentError(absl::StrCat(path, ": has no ", kWorldTopic));
  const size_t regions = client::EndpointsOf(*out.world).size();
  if (out.snapshots.size() != regions) {
    return absl::InvalidArgumentError(
        absl::StrCat(path, ": has the snapshots of ", out.snapshots.size(), " of ", regions, " regions"));
  }
  std::erase_if(out.hashes, [&](const auto& e) { return told[e.first] < regions; });
  return out;
}

}  // namespace aureole
