// The side of the links that is dialled: accepts streams, checks who calls, and hands them to the right link.
#pragma once

#include <atomic>
#include <cstdint>
#include <map>
#include <mutex>
#include <vector>

#include <grpcpp/server_builder.h>

#include "aureole/v1/peer.grpc.pb.h"
#include "server/transport/peer_link.h"

namespace aureole {

class PeerService final : public v1::Peer::CallbackService {
 public:
  // Until Serve, callers are told UNAVAILABLE and try again.
  grpc::ServerBidiReactor<v1::PeerMessage, v1::PeerMessage>* Link(grpc::CallbackServerContext* context) override;

  // From here on the peers of `links` are accepted. The links outlive the next Stop.
  void Serve(const LinkIdentity& identity, const std::vector<PeerLink*>& links);
  // One more, or one less: no further stream is handed to it. Ignored when it is not there.
  void Add(PeerLink* link);
  void Remove(const PeerLink* link);
  // Hands no further stream to a link.
  void Stop();

  // Streams that were refused at their hello, since the start.
  int64_t refused() const;

  // Called by streams: attaches the stream to the caller's link, which is stored first, as the link may write at once.
  absl::Status Attach(LinkStream* stream, const v1::PeerMessage& first, std::atomic<PeerLink*>* link);

 private:
  absl::StatusOr<PeerLink*> Find(const v1::PeerMessage& first) const;

  mutable std::mutex mutex_;
  bool serving_ = false;
  LinkIdentity identity_;
  std::map<RegionId, PeerLink*> links_;
  int64_t refused_ = 0;
};

// The limits and probes of a server that takes links: message size, keepalive, few threads.
void ConfigureServer(grpc::ServerBuilder* builder);

}  // namespace aureole
