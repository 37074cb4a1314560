// Links over real sockets: exactly once and in order whatever happens to the connection; what does not match is
// refused.
#include <gtest/gtest.h>

#include <grpcpp/grpcpp.h>

#include <condition_variable>
#include <mutex>
#include <random>

#include "server/transport/frame_codec.h"
#include "server/transport/link_limits.h"
#include "server/transport/peer_link.h"
#include "server/transport/peer_service.h"

namespace aureole {
namespace {

using std::chrono::seconds;

LinkIdentity Identity(RegionId self) { return {kPeerProtocolVersion, 0xABCDEF, 3, self, 1, 0, 16000}; }

// One region's end: a server, and the link to its only peer.
class End {
 public:
  // `incarnation` > 0: one that makes checkpoints, and was loaded from one.
  End(RegionId self, RegionId peer, uint64_t incarnation = 0, LinkState state = {}, Tick log_until = 0)
      : identity_(Identity(self)), link_(Options(peer, incarnation, std::move(state), log_until)) {
    grpc::ServerBuilder builder;
    ConfigureServer(&builder);
    builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port_);
    builder.RegisterService(&service_);
    server_ = builder.BuildAndStart();
    std::vector<PeerLink*> links;
    if (peer < self) links.push_back(&link_);
    service_.Serve(identity_, links);
  }
  ~End() {
    service_.Stop();
    link_.Close();
    server_->Shutdown(std::chrono::system_clock::now() + seconds(1));
  }

  std::string endpoint() const { return "127.0.0.1:" + std::to_string(port_); }
  PeerLink& link() { return link_; }
  PeerService& service() { return service_; }
  void Send(const Frame& frame) { link_.Send(std::make_shared<const std::string>(EncodeFrame(frame))); }

  // Waits until `n` frames have arrived in all; false after 60 s.
  bool Await(size_t n) {
    std::unique_lock lock(mutex_);
    return changed_.wait_for(lock, seconds(60), [&] { return frames_.size() >= n; });
  }
  std::vector<Frame> frames() {
    const std::lock_guard lock(mutex_);
    return frames_;
  }
  std::string log() {
    const std::lock_guard lock(mutex_);
    return log_;
  }

 private:
  PeerLink::Options Options(RegionId peer, uint64_t incarnation, LinkState state, Tick log_until) {
    identity_.incarnation = std::max<uint64_t>(1, incarnation);
    identity_.log_until = log_until;
    const auto log = [this](RegionId, const std::string& s) {
      const std::lock_guard lock(mutex_);
      log_ += s + "\n";
    };
    return {identity_, peer, deliver(), log, incarnation > 0, std::move(state)};
  }
  std::function<void(Frame)> deliver() {
    return [this](Frame frame) {
      const std::lock_guard lock(mutex_);
      frames_.push_back(std::move(frame));
      changed_.notify_all();
    };
  }

  std::mutex mutex_;
  std::condition_variable changed_;
  std::vector<Frame> frames_;
  std::string log_;
  LinkIdentity identity_;
  PeerService service_;
  PeerLink link_;
  int port_ = 0;
  std::unique_ptr<grpc::Server> server_;
};

Frame EmptyFrame(Tick tick, int round = 0) {
  Frame f;
  f.tick = tick;
  f.round = round;
  return f;
}

Frame FrameOf(Tick tick, size_t state_bytes) {
  Frame f = EmptyFrame(tick);
  f.gone = {static_cast<BodyId>(tick)};
  if (state_bytes > 0) {
    Transfer t;
    t.ids = {static_cast<BodyId>(tick)};
    t.epochs = {1};
    t.state.assign(state_bytes, static_cast<char>(tick));
    f.transfers.push_back(std::move(t));
  }
  return f;
}

TEST(PeerLink, EveryFrameArrivesOnceInOrderWhileConnectionsAreCut) {
  constexpr Tick kFrames = 10000, kWindow = 100;
  End low(0, 1), high(1, 0);
  low.link().Dial(high.endpoint());
  std::mt19937_64 random(1);
  int cuts = 0;
  for (Tick tick = 1; tick <= kFrames; ++tick) {
    // Now and then a cluster that needs several messages.
    const size_t bytes = tick % 500 == 0 ? 3 * kPartBytes + 17 : random() % 200;
    low.Send(FrameOf(tick, bytes));
    high.Send(FrameOf(tick, random() % 100));
    if (tick > kWindow) {
      ASSERT_TRUE(low.Await(tick - kWindow) && high.Await(tick - kWindow)) << tick << low.log() << high.log();
    }
    if (random() % 150 == 0) {
      (random() % 2 == 0 ? low : high).link().Cut();
      ++cuts;
    }
  }
  ASSERT_TRUE(low.Await(kFrames) && high.Await(kFrames));
  for (End* end : {&low, &high}) {
    const std::vector<Frame> frames = end->frames();
    ASSERT_EQ(frames.size(), static_cast<size_t>(kFrames));
    for (Tick tick = 1; tick <= kFrames; ++tick) {
      const Frame& f = frames[tick - 1];
      ASSERT_EQ(f.tick, tick);
      ASSERT_EQ(f.gone, std::vector<BodyId>{static_cast<BodyId>(tick)});
      for (const Transfer& t : f.transfers) ASSERT_EQ(t.state, std::string(t.state.size(), static_cast<char>(tick)));
    }
    EXPECT_EQ(end->link().stats().refused_frames, 0);
  }
  EXPECT_EQ(high.frames()[499].transfers.at(0).state.size(), 3 * kPartBytes + 17);
  EXPECT_GT(cuts, 40);
  EXPECT_GT(low.link().stats().reconnects, cuts / 2);  // two cuts may fall into one connection
}

TEST(PeerLink, EmptyBorderCostsAtMostThirtyTwoBytesPerTick) {
  constexpr Tick kFirst = 1 << 20, kTicks = 1000;
  End low(0, 1), high(1, 0);
  low.link().Dial(high.endpoint());
  for (Tick n = 0; n < kTicks; ++n) {
    for (int round = 0; round < 2; ++round) {
      low.Send(EmptyFrame(kFirst + n, round));
      high.Send(EmptyFrame(kFirst + n, round));
      ASSERT_TRUE(low.Await(2 * n + round + 1) && high.Await(2 * n + round + 1));
    }
  }
  const int64_t bytes = low.link().stats().bytes_sent + high.link().stats().bytes_sent;
  EXPECT_LE(bytes, 32 * kTicks) << "both directions";
  RecordProperty("bytes_per_tick", std::to_string(static_cast<double>(bytes) / kTicks));
  // Nothing is kept for long: acknowledgements come with the frames.
  EXPECT_EQ(high.frames().back().tick, kFirst + kTicks - 1);
}

TEST(PeerLink, OneWayTrafficIsAcknowledgedAlone) {
  End low(0, 1), high(1, 0);
  low.link().Dial(high.endpoint());
  for (Tick n = 1; n <= 1000; ++n) {
    low.Send(EmptyFrame(n));
    ASSERT_TRUE(high.Await(static_cast<size_t>(n)));
  }
  for (int i = 0; i < 1000 && low.link().stats().frames_kept > 64; ++i)
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  EXPECT_LE(low.link().stats().frames_kept, 64);
}

TEST(PeerLink, FramesSentBeforeTheConnectionArrive) {
  End low(0, 1), high(1, 0);
  for (Tick n = 1; n <= 10; ++n) low.Send(EmptyFrame(n));
  low.link().Dial(high.endpoint());
  EXPECT_TRUE(high.Await(10));
  EXPECT_TRUE(low.link().AwaitWritten(seconds(10)));
}

TEST(PeerLink, DiallerWaitsForAPeerThatHasNoRegionYet) {
  End low(0, 1), high(1, 0);
  high.service().Stop();
  low.Send(EmptyFrame(1));
  low.link().Dial(high.endpoint());
  const auto deadline = std::chrono::steady_clock::now() + seconds(30);
  while (low.log().find("no region at present") == std::string::npos) {
    ASSERT_LT(std::chrono::steady_clock::now(), deadline);
    std::this_thread::yield();
  }
  high.service().Serve(Identity(1), {&high.link()});
  EXPECT_TRUE(high.Await(1));
  EXPECT_EQ(low.link().stats().refused_hellos, 0);
}

// A hand-made peer, to say what no PeerLink says.
class RawPeer {
 public:
  explicit RawPeer(const std::string& endpoint)
      : stub_(v1::Peer::NewStub(grpc::CreateChannel(endpoint, grpc::InsecureChannelCredentials()))) {
    context_.set_deadline(std::chrono::system_clock::now() + seconds(30));
    stream_ = stub_->Link(&context_);
  }
  ~RawPeer() {
    context_.TryCancel();
    if (!finished_) stream_->Finish();
  }
  static v1::LinkHello Hello(RegionId from, RegionId to) {
    const LinkIdentity id = Identity(from);
    v1::LinkHello hello;
    hello.set_protocol_version(id.protocol_version);
    hello.set_world_hash(id.world_hash);
    hello.set_layout_epoch(id.layout_epoch);
    hello.set_from(from);
    hello.set_to(to);
    hello.set_incarnation(id.incarnation);
    hello.set_exchange_delay(0);
    hello.set_tick_us(id.tick_us);
    return hello;
  }
  void Say(const v1::LinkHello& hello) {
    v1::PeerMessage message;
    *message.mutable_hello() = hello;
    stream_->Write(message);
  }
  void Say(const v1::PeerMessage& message) { stream_->Write(message); }
  void Say(uint64_t sequence, const std::string& frame, bool more = false) {
    v1::PeerMessage message;
    message.set_sequence(sequence);
    message.set_frame(frame);
    message.set_more(more);
    stream_->Write(message);
  }
  bool Hear(v1::PeerMessage* message) { return stream_->Read(message); }
  // Reads to the end.
  grpc::Status Verdict() {
    v1::PeerMessage message;
    while (stream_->Read(&message)) {
    }
    finished_ = true;
    return stream_->Finish();
  }

 private:
  std::unique_ptr<v1::Peer::Stub> stub_;
  grpc::ClientContext context_;
  std::unique_ptr<grpc::ClientReaderWriter<v1::PeerMessage, v1::PeerMessage>> stream_;
  bool finished_ = false;
};

TEST(Handshake, WhatDiffersIsNamed) {
  End high(1, 0);
  int refusals = 0;
  const auto refused = [&](const char* what, auto change) {
    v1::LinkHello hello = RawPeer::Hello(0, 1);
    change(&hello);
    RawPeer raw(high.endpoint());
    raw.Say(hello);
    const grpc::Status verdict = raw.Verdict();
    EXPECT_EQ(verdict.error_code(), grpc::StatusCode::FAILED_PRECONDITION) << what;
    EXPECT_NE(verdict.error_message().find(what), std::string::npos) << verdict.error_message();
    EXPECT_EQ(high.service().refused(), ++refusals);
  };
  refused("protocol version is 7 here and 9 in region 0", [](v1::LinkHello* h) { h->set_protocol_version(9); });
  refused("world hash is 0000000000abcdef here and 0000000000000005", [](v1::LinkHello* h) { h->set_world_hash(5); });
  refused("layout epoch is 3 here and 4", [](v1::LinkHello* h) { h->set_layout_epoch(4); });
  refused("exchange delay is 0 here and 2", [](v1::LinkHello* h) { h->set_exchange_delay(2); });
  refused("tick length in us is 16000 here and 16667", [](v1::LinkHello* h) { h->set_tick_us(16667); });
  refused("region 0 looks for region 7 here", [](v1::LinkHello* h) { h->set_to(7); });
  refused("region 5 does not dial this region", [](v1::LinkHello* h) { h->set_from(5); });
  refused("has applied frame 3", [](v1::LinkHello* h) { h->set_applied(3); });
  refused("is incarnation 0", [](v1::LinkHello* h) { h->set_incarnation(0); });
  EXPECT_EQ(high.link().stats().connections, 0);
  EXPECT_TRUE(high.frames().empty());
}

TEST(Handshake, DiallerOfAnotherWorldIsRefusedAndCountsIt) {
  End high(1, 0);
  LinkIdentity other = Identity(0);
  other.world_hash = 1;
  std::mutex mutex;
  std::string log;
  PeerLink link({other,
                 1,
                 [](Frame) { FAIL(); },
                 [&](RegionId, const std::string& s) {
                   const std::lock_guard lock(mutex);
                   log += s + "\n";
                 },
                 false,
                 {}});
  link.Dial(high.endpoint());
  const auto deadline = std::chrono::steady_clock::now() + seconds(30);
  while (link.stats().refused_hellos < 2) {
    ASSERT_LT(std::chrono::steady_clock::now(), deadline);
    std::this_thread::yield();
  }
  link.Close();
  const std::lock_guard lock(mutex);
  EXPECT_NE(log.find("world hash"), std::string::npos);
  EXPECT_EQ(log.find('\n'), log.size() - 1) << "logged once, not at every attempt: " << log;
}

TEST(PeerLink, RegionThatDiedGoesOnFromItsCheckpoint) {
  End high(1, 0, 1);
  auto low = std::make_unique<End>(0, 1, 1);
  low->link().Dial(high.endpoint());
  const auto send = [](End* end, Tick first, Tick last) {
    for (Tick n = first; n <= last; ++n) end->Send(EmptyFrame(n));
  };
  send(low.get(), 1, 5);
  send(&high, 1, 5);
  ASSERT_TRUE(high.Await(5) && low->Await(5));
  LinkState checkpoint = low->link().State();  // nothing is durable at the other side
  EXPECT_EQ(checkpoint.kept.size(), 5);
  checkpoint.applied = 3;  // it has used no more of them
  low->link().SetDurable(2);
  send(low.get(), 6, 8);
  send(&high, 6, 9);
  ASSERT_TRUE(high.Await(8) && low->Await(9));
  while (high.link().stats().frames_kept > 7) std::this_thread::yield();  // those after the second

  low.reset();
  low = std::make_unique<End>(0, 1, 2, checkpoint, 77);
  low->link().Dial(high.endpoint());
  ASSERT_TRUE(low->Await(6));  // 4 to 9 again
  EXPECT_EQ(high.link().log_until(), 77);
  EXPECT_EQ(low->frames().front().tick, 4);
  EXPECT_FALSE(low->link().caught_up());
  send(low.get(), 6, 8);  // what the other side has had
  EXPECT_TRUE(low->link().caught_up());
  send(low.get(), 9, 9);
  ASSERT_TRUE(high.Await(9));
  EXPECT_EQ(high.frames().back().tick, 9);
  EXPECT_EQ(high.link().stats().duplicates, 0);
  send(&high, 10, 10);
  ASSERT_TRUE(low->Await(7));
  EXPECT_EQ(low->frames().back().tick, 10);
  EXPECT_EQ(high.link().stats().refused_frames + low->link().stats().refused_frames, 0);
}

TEST(PeerLink, DiallerFollowsItsPeerToAnotherEndpoint) {
  auto high = std::make_unique<End>(1, 0, 1);
  End low(0, 1, 1);
  low.link().Dial(high->endpoint());
  low.Send(EmptyFrame(1));
  ASSERT_TRUE(high->Await(1));
  high = nullptr;
  End moved(1, 0, 2);
  low.link().Redirect(moved.endpoint(), 2);
  ASSERT_TRUE(moved.Await(1));
  low.Send(EmptyFrame(2));
  ASSERT_TRUE(moved.Await(2));
}

TEST(Handshake, ReplacedIncarnationIsFenced) {
  End high(1, 0, 1);
  high.link().Redirect("", 3);
  RawPeer raw(high.endpoint());
  v1::LinkHello hello = RawPeer::Hello(0, 1);
  hello.set_incarnation(2);
  hello.set_keep(true);
  raw.Say(hello);
  EXPECT_NE(raw.Verdict().error_message().find("incarnation 3 is known: it has been replaced"), std::string::npos);
}

TEST(Handshake, RestartedPeerCannotGoOnWithoutCheckpoints) {
  End high(1, 0);
  {
    RawPeer raw(high.endpoint());
    raw.Say(RawPeer::Hello(0, 1));
    v1::PeerMessage answer;
    ASSERT_TRUE(raw.Hear(&answer));
    EXPECT_EQ(answer.hello().from(), 1);
  }
  RawPeer raw(high.endpoint());
  v1::LinkHello hello = RawPeer::Hello(0, 1);
  hello.set_incarnation(2);
  raw.Say(hello);
  EXPECT_NE(raw.Verdict().error_message().find("is incarnation 2, was 1"), std::string::npos);
}

TEST(Malformed, ClosesTheLinkIsCountedAndChangesNothing) {
  End high(1, 0);
  int refusals = 0;
  const auto refused = [&](const char* why, auto say) {
    RawPeer raw(high.endpoint());
    raw.Say(RawPeer::Hello(0, 1));
    say(&raw);
    const grpc::Status verdict = raw.Verdict();
    EXPECT_EQ(verdict.error_code(), grpc::StatusCode::INVALID_ARGUMENT) << why;
    EXPECT_NE(verdict.error_message().find(why), std::string::npos) << verdict.error_message();
    EXPECT_EQ(high.link().stats().refused_frames, ++refusals);
  };
  const std::string good = EncodeFrame(EmptyFrame(1));
  refused("not a Frame message", [](RawPeer* p) { p->Say(1, "\xff\xff"); });
  refused("frame.gone_id", [](RawPeer* p) {
    v1::Frame frame;
    frame.add_gone_id(0);
    p->Say(1, frame.SerializeAsString());
  });
  refused("frame 2 after frame 0", [&](RawPeer* p) { p->Say(2, good); });
  refused("has no number", [&](RawPeer* p) { p->Say(0, good); });
  refused("a new frame within another", [&](RawPeer* p) {
    p->Say(1, good, true);
    p->Say(2, good);
  });
  refused("acknowledges frame 8", [&](RawPeer* p) {
    v1::PeerMessage message;
    message.set_applied(8);
    p->Say(message);
  });
  refused("more than", [](RawPeer* p) {
    for (size_t n = 0; n <= kMaxFrameBytes / kPartBytes; ++n) p->Say(n == 0, std::string(kPartBytes, 'x'), true);
  });
  EXPECT_TRUE(high.frames().empty());
  // A good peer is served as before.
  End low(0, 1);
  low.Send(EmptyFrame(1));
  low.link().Dial(high.endpoint());
  EXPECT_TRUE(high.Await(1));
}

TEST(Malformed, RandomMessagesNeverReachTheRegion) {
  End high(1, 0);
  std::mt19937_64 random(2);
  for (int n = 0; n < 300; ++n) {
    std::string bytes(1 + random() % 60, 0);
    for (char& c : bytes) c = static_cast<char>(random());
    bytes[0] = '\x07';  // wire type 7 does not exist
    RawPeer raw(high.endpoint());
    raw.Say(RawPeer::Hello(0, 1));
    raw.Say(1, bytes);
    EXPECT_EQ(raw.Verdict().error_code(), grpc::StatusCode::INVALID_ARGUMENT);
  }
  EXPECT_EQ(high.link().stats().refused_frames, 300);
  EXPECT_TRUE(high.frames().empty());
}

TEST(Malformed, RepeatedFramesAreIgnored) {
  End high(1, 0);
  for (int connection = 0; connection < 2; ++connection) {
    RawPeer raw(high.endpoint());
    raw.Say(RawPeer::Hello(0, 1));
    raw.Say(1, EncodeFrame(EmptyFrame(1)));
    raw.Say(2, EncodeFrame(EmptyFrame(2)));
    if (connection == 1) raw.Say(0, EncodeFrame(EmptyFrame(3)));
    ASSERT_TRUE(high.Await(2 + connection));
  }
  const std::vector<Frame> frames = high.frames();
  ASSERT_EQ(frames.size(), 3u);
  for (Tick n = 0; n < 3; ++n) EXPECT_EQ(frames[n].tick, n + 1);
  EXPECT_EQ(high.link().stats().duplicates, 2);
}

}  // namespace
}  // namespace aureole
