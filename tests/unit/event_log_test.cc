#include "server/control/event_log.h"

#include <grpcpp/grpcpp.h>
#include <gtest/gtest.h>

#include <thread>

namespace aureole {
namespace {

RunEvent EventOf(const std::string& what, uint64_t sequence = 0) {
  return {std::chrono::system_clock::now(), v1::ControlEvent::REGION_REPLACED, 1, what, sequence};
}

// A log behind a socket.
class EventLogTest : public testing::Test, public v1::ControlPlane::CallbackService {
 protected:
  ~EventLogTest() override {
    if (log_ != nullptr) log_->End();
    if (server_ != nullptr) server_->Shutdown(std::chrono::system_clock::now() + std::chrono::seconds(5));
    log_.reset();
  }

  void Serve(std::vector<RunEvent> kept = {}, size_t most = EventLog::kMostEvents) {
    log_ = std::make_unique<EventLog>(std::move(kept), most);
    grpc::ServerBuilder builder;
    int port = 0;
    builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
    builder.RegisterService(this);
    server_ = builder.BuildAndStart();
    stub_ = v1::ControlPlane::NewStub(
        grpc::CreateChannel("127.0.0.1:" + std::to_string(port), grpc::InsecureChannelCredentials()));
  }
  grpc::ServerWriteReactor<v1::ControlEvent>* WatchEvents(grpc::CallbackServerContext* context,
                                                          const v1::WatchEventsRequest* request) override {
    return log_->Watch(context, *request);
  }

  struct Call {
    grpc::ClientContext context;
    std::unique_ptr<grpc::ClientReaderInterface<v1::ControlEvent>> stream;
    v1::ControlEvent event;
    bool Read() { return stream->Read(&event); }
  };
  std::unique_ptr<Call> Watch(uint64_t after, bool follow) {
    auto call = std::make_unique<Call>();
    call->context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(30));
    v1::WatchEventsRequest request;
    request.set_after_sequence(after);
    request.set_follow(follow);
    call->stream = stub_->WatchEvents(&call->context, request);
    return call;
  }
  // Of a call that ends by itself.
  std::vector<v1::ControlEvent> All(uint64_t after = 0) {
    const auto call = Watch(after, false);
    std::vector<v1::ControlEvent> out;
    while (call->Read()) out.push_back(call->event);
    const grpc::Status s = call->stream->Finish();
    EXPECT_TRUE(s.ok()) << s.error_message();
    return out;
  }

  std::unique_ptr<EventLog> log_;
  std::unique_ptr<grpc::Server> server_;
  std::unique_ptr<v1::ControlPlane::Stub> stub_;
};

TEST_F(EventLogTest, TellsWhatHasHappenedAndEnds) {
  Serve();
  EXPECT_TRUE(All().empty());
  log_->Add(EventOf("one"));
  log_->Add({std::chrono::system_clock::time_point(std::chrono::microseconds(7)), v1::ControlEvent::LAYOUT_IN_FORCE,
             kNoRegion, "two"});
  const std::vector<v1::ControlEvent> all = All();
  ASSERT_EQ(all.size(), 2u);
  EXPECT_EQ(all[0].text(), "one");
  EXPECT_EQ(all[0].region(), 1);
  EXPECT_TRUE(all[0].warning());
  EXPECT_EQ(all[1].kind(), v1::ControlEvent::LAYOUT_IN_FORCE);
  EXPECT_FALSE(all[1].warning());
  EXPECT_FALSE(all[1].has_region());
  EXPECT_EQ(all[1].unix_us(), 7);
  EXPECT_EQ(All(all[0].sequence()).size(), 1u);
  EXPECT_EQ(All(all[1].sequence()).size(), 0u);
}

TEST_F(EventLogTest, FollowersHearWhatHappensThen) {
  Serve();
  log_->Add(EventOf("before"));
  const auto call = Watch(0, true);
  ASSERT_TRUE(call->Read());
  for (int i = 0; i < 100; ++i) {
    log_->Add(EventOf(std::to_string(i)));
    ASSERT_TRUE(call->Read());
    EXPECT_EQ(call->event.text(), std::to_string(i));
    EXPECT_EQ(call->event.missed(), 0);
  }
  log_->End();
  EXPECT_FALSE(call->Read());
  EXPECT_EQ(call->stream->Finish().error_code(), grpc::StatusCode::UNAVAILABLE);
}

TEST_F(EventLogTest, SequencesGrowFromOneControlPlaneToTheNext) {
  std::vector<RunEvent> kept;
  {
    EventLog first;
    for (const char* what : {"one", "two"}) kept.push_back(first.Add(EventOf(what)));
  }
  EXPECT_GT(EventLog().Add(EventOf("without a store")).sequence, kept.back().sequence);
  Serve(kept);
  log_->Add(EventOf("three"));
  const std::vector<v1::ControlEvent> all = All();
  ASSERT_EQ(all.size(), 3u);
  EXPECT_EQ(all[0].text(), "one");
  EXPECT_EQ(all[0].sequence(), kept[0].sequence);
  EXPECT_GT(all[2].sequence(), kept[1].sequence);
  EXPECT_EQ(all[2].missed(), 0) << "the gap between two control planes is none";
  EXPECT_EQ(All(kept[1].sequence).size(), 1u);
  const uint64_t late = kept[1].sequence + (uint64_t{1} << 60);
  EXPECT_EQ(EventLog({EventOf("of a clock that was ahead", late)}).Add(EventOf("next")).sequence, late + 1);
}

TEST_F(EventLogTest, SlowReaderHoldsNobodyUpAndHearsWhatItHasMissed) {
  constexpr int kEvents = 3000;
  Serve({}, 16);
  const auto slow = Watch(0, true);
  log_->Add(EventOf("first"));
  ASSERT_TRUE(slow->Read());
  const std::string large(4096, 'x');
  const auto since = std::chrono::steady_clock::now();
  for (int i = 0; i < kEvents; ++i) log_->Add(EventOf(large));
  EXPECT_LT(std::chrono::steady_clock::now() - since, std::chrono::seconds(5));
  log_->Add(EventOf("last"));
  int read = 1;
  int64_t missed = 0;
  while (slow->event.text() != "last" && slow->Read()) {
    ++read;
    missed += slow->event.missed();
  }
  EXPECT_EQ(slow->event.text(), "last");
  EXPECT_GT(missed, 0);
  EXPECT_EQ(read + missed, kEvents + 2);
  ASSERT_EQ(All().size(), 16u);
  EXPECT_EQ(All()[0].missed(), kEvents + 2 - 16);
}

TEST_F(EventLogTest, MoreStreamsThanItTakesAreRefused) {
  Serve();
  log_->Add(EventOf("one"));
  std::vector<std::unique_ptr<Call>> calls;
  for (size_t i = 0; i < EventLog::kMostStreams; ++i) {
    calls.push_back(Watch(0, true));
    ASSERT_TRUE(calls.back()->Read());
  }
  const auto more = Watch(0, true);
  EXPECT_FALSE(more->Read());
  EXPECT_EQ(more->stream->Finish().error_code(), grpc::StatusCode::RESOURCE_EXHAUSTED);
  calls.clear();
}

}  // namespace
}  // namespace aureole
