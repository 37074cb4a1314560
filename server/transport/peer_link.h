// One link: the frames between this region and one peer, exactly once and in order, over any number of connections.
//
// Frames to send are kept until the peer has acknowledged them, or, when it makes checkpoints, until they are durable
// there; a new connection goes on after the last one that the peer applied (server/core/link.h, P54). A peer that died
// and was loaded from its checkpoint comes with a higher incarnation, and gets again what it has lost. One write is in
// flight at a time. The side with the lower region id dials, and dials again when the connection ends, 50 ms to 1 s
// later (P57). Nothing here waits: the tick thread only ever queues a frame, and received frames are handed to
// `deliver`.
#pragma once

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <utility>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>
#include <grpcpp/alarm.h>
#include <grpcpp/channel.h>
#include <grpcpp/security/credentials.h>

#include "aureole/v1/peer.grpc.pb.h"
#include "server/core/frame.h"
#include "server/core/link.h"

namespace aureole {

// What both ends of a link must agree on, and who this end is.
struct LinkIdentity {
  uint32_t protocol_version = 0;
  uint64_t world_hash = 0;
  uint64_t layout_epoch = 0;  // of the layout with which the two became peers
  RegionId self = kNoRegion;
  uint64_t incarnation = 1;  // from 1
  int exchange_delay = 0;    // k
  int64_t tick_us = 0;
  Tick log_until = 0;  // of the inputs that it has to repeat; 0: none
};

// FailedPrecondition says what differs and what to do, when `hello` is not from the same world, layout, protocol
// version and exchange, or not for this region.
absl::Status CheckHello(const LinkIdentity& identity, const v1::LinkHello& hello);

// A serialised frame; shared, since a broadcast goes to every link.
using EncodedFrame = std::shared_ptr<const std::string>;

// What of a link goes into a checkpoint.
struct LinkState {
  uint64_t epoch = 0;             // LinkIdentity::layout_epoch
  uint64_t applied = 0;           // frames of the peer
  uint64_t first = 1;             // number of kept.front()
  std::deque<EncodedFrame> kept;  // frames that the peer may yet need
};

// So many frames of the peer, on the link of this epoch.
struct LinkMark {
  uint64_t epoch = 0, frames = 0;
  friend bool operator==(const LinkMark&, const LinkMark&) = default;
};

// Totals since the start.
struct LinkStats {
  int64_t frames_sent = 0;      // written, frames repeated after a reconnect included
  int64_t frames_received = 0;  // applied
  int64_t frames_kept = 0;      // now, until they are acknowledged
  int64_t bytes_sent = 0;       // of messages: payload, without gRPC's framing
  int64_t connections = 0;      // that passed the handshake
  int64_t reconnects = 0;       // of these, all but the first
  int64_t refused_hellos = 0;
  int64_t refused_frames = 0;  // malformed, or out of sequence
  int64_t duplicates = 0;
  friend bool operator==(const LinkStats&, const LinkStats&) = default;
};

// One connection of a link; the dialled and the accepted kind differ only in gRPC's classes. Its fields are guarded by
// the link's mutex once the link has it.
class LinkStream {
 public:
  virtual ~LinkStream() = default;
  virtual void StartWriting(const v1::PeerMessage* message) = 0;
  // Ends the connection soon, from any thread.
  virtual void Cancel() = 0;

  v1::PeerMessage out;                                  // the message in flight
  bool writing = false;                                 // a write is in flight
  bool open = false;                                    // the peer's hello was accepted, and no write has failed
  bool ended = false;                                   // no write may start any more
  std::deque<std::pair<uint64_t, EncodedFrame>> queue;  // numbered frames that this connection has still to carry
  size_t written = 0;                                   // bytes of the first of them already written, in parts
  bool sequence_said = false;                           // the numbers have begun
  // Only touched by the stream's reads, which come one at a time.
  bool greeted = false;    // the peer's hello was accepted
  uint64_t last_read = 0;  // number of the last frame begun; 0: none yet
  std::string parts;       // of the frame that is being received
  bool in_parts = false;
};

class PeerLink {
 public:
  struct Options {
    LinkIdentity identity;
    RegionId peer = kNoRegion;
    // Takes the next frame of the peer; from a gRPC thread, one at a time. Must be quick and not call this link.
    std::function<void(Frame)> deliver;
    // Told of what an operator wants to know: connected, lost, refused. From a gRPC thread; must not call this link.
    std::function<void(RegionId peer, const std::string& what)> log;
    // This region makes checkpoints: the peer keeps its frames until SetDurable says that it need not.
    bool keep = false;
    // Where an earlier incarnation of this region left off.
    LinkState state;
  };

  explicit PeerLink(Options options);
  // Closes.
  ~PeerLink();
  PeerLink(const PeerLink&) = delete;
  PeerLink& operator=(const PeerLink&) = delete;

  RegionId peer() const { return options_.peer; }
  // Of the layout with which the two regions became peers.
  uint64_t epoch() const { return options_.identity.layout_epoch; }

  // Connects, and stays connected until Close. Once; only the side with the lower id.
  void Dial(const std::string& endpoint,
            const std::shared_ptr<grpc::ChannelCredentials>& credentials = grpc::InsecureChannelCredentials());
  // From here on the peer is this incarnation, at this endpoint: older ones are refused, and when this side dials, it
  // dials there. Empty: not known yet. Ignored when a newer incarnation is known.
  void Redirect(const std::string& endpoint, uint64_t incarnation);
  // Any thread; never waits for the network.
  void Send(EncodedFrame frame);
  // Frames of the peer are durable here up to this number.
  void SetDurable(uint64_t frames);
  // What is kept for the peer; `applied` is left 0: it is the reader of the frames that knows what it has used. After
  // Part it is all that came.
  LinkState State() const;
  // The two are no peers any more: all that came was used, and nothing more is sent. The link stays until the other
  // side has what it needs; what came is acknowledged at once, or when it is durable.
  void Part();
  // The peer needs no frame again that it was sent.
  bool released() const;
  // The peer, this incarnation of it, has been connected.
  bool met() const;
  // The peer was met, and has had no frame of an earlier incarnation of this region that this one has not sent again.
  bool caught_up() const;
  // The last tick of the peer's log of inputs, as its hellos said.
  Tick log_until() const;
  // Ends the present connection, if any, as a fault of the network would; the link resumes. Any thread.
  void Cut();
  // Waits until every frame was written to a connection; false when that took longer.
  bool AwaitWritten(std::chrono::milliseconds at_most);
  // Ends the connection and waits until no callback will come any more. Idempotent.
  void Close();

  LinkStats stats() const;

  // Below: called by streams.

  // The peer has dialled and said `hello`. When OK, the stream belongs to this link and has its answer under way.
  absl::Status Attach(LinkStream* stream, const v1::LinkHello& hello);
  // Anything that a stream has read. Not OK: the connection must end, for this reason.
  absl::Status Read(LinkStream* stream, v1::PeerMessage* message);
  // A write is done. True when the stream has ended meanwhile.
  bool Written(LinkStream* stream, bool ok);
  // Nothing more will be read, and no further write may start. True when none is in flight.
  bool End(LinkStream* stream);
  // The connection is over, for the dialled side's reason `status`; the link forgets the stream.
  void Gone(LinkStream* stream, const grpc::Status& status);
  // After Gone, once the stream has been deleted: what it held of gRPC must not outlive Close. gRPC 1.51 breaks when
  // the last holder of a channel is one of its own threads (grpc/grpc#32584).
  void Released();

 private:
  v1::LinkHello Hello() const;
  absl::Status Accept(LinkStream* stream, const v1::LinkHello& hello);
  absl::Status ReadHello(LinkStream* stream, const v1::LinkHello& hello);
  void LogOnce(const std::string& why);
  absl::StatusOr<bool> Assemble(LinkStream* stream, v1::PeerMessage* message, std::string* frame) const;
  absl::Status Apply(LinkStream* stream, const v1::PeerMessage& message, Frame* frame);
  void Pump(LinkStream* stream);
  void PutFrame(LinkStream* stream);
  void OpenChannel(const std::string& endpoint);
  void Connect();
  void Redial();

  const Options options_;
  std::string endpoint_;
  std::shared_ptr<grpc::ChannelCredentials> credentials_;
  std::shared_ptr<grpc::Channel> channel_;
  std::vector<std::shared_ptr<grpc::Channel>> old_channels_;  // kept as long as their streams may be (see Released)
  std::unique_ptr<v1::Peer::Stub> stub_;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  LinkSender<EncodedFrame> sender_;
  LinkReceiver receiver_;
  uint64_t told_ = 0;  // what the peer knows that we applied
  uint64_t durable_ = 0, told_durable_ = 0;
  bool parted_ = false;
  bool peer_met_ = false;    // this incarnation of it
  bool peer_keeps_ = false;  // as its hello says
  Tick peer_log_until_ = 0;
  uint64_t peer_applied_ = 0;      // by its last hello
  uint64_t peer_incarnation_ = 0;  // 0: not met yet
  LinkStream* current_ = nullptr;
  int streams_ = 0;  // not yet released
  bool closed_ = false;
  bool redialling_ = false;
  int backoff_ms_;
  std::string last_refusal_;  // so that a standing refusal is logged once
  LinkStats stats_;
  std::unique_ptr<grpc::Alarm> alarm_;  // the next dial
};

}  // namespace aureole
