// One run, from the first Hello to the last Stop, with made-up region servers in threads.
#include "server/control/run.h"

#include <gtest/gtest.h>

#include <map>
#include <memory>
#include <mutex>
#include <thread>

#include "server/control/control_plane_service.h"
#include "server/transport/world_spec.h"
#include "tests/e2e/fake_region.h"

namespace aureole {
namespace {

using ::testing::Test;

class FakeAllocator final : public Allocator {
 public:
  explicit FakeAllocator(FakeBehaviour behaviour) : behaviour_(std::move(behaviour)) {}
  ~FakeAllocator() override { Kill(); }

  absl::Status Start(const ServerStart& start) override {
    auto server = std::make_unique<Server>();
    Server* s = server.get();
    s->region = start.region;
    s->incarnation = start.incarnation;
    s->fake = std::make_unique<FakeRegion>(start.control, start.token, behaviour_);
    s->thread = std::thread([s] {
      s->exit = s->fake->Run();
      s->ended = true;
    });
    servers_.push_back(std::move(server));
    return absl::OkStatus();
  }
  std::vector<ServerExit> Poll() override {
    std::vector<ServerExit> out;
    for (const auto& s : servers_) {
      if (!s->ended || !s->thread.joinable()) continue;
      s->thread.join();
      out.push_back(
          {s->region, s->incarnation, s->exit == 0, "exit status " + std::to_string(s->exit), "", "its last words"});
    }
    return out;
  }
  int running() const override {
    int n = 0;
    for (const auto& s : servers_) n += s->thread.joinable() ? 1 : 0;
    return n;
  }
  void End(RegionId region, uint64_t) override {
    for (const auto& s : servers_) {
      if (s->region == region) s->fake->Cancel();
    }
  }
  void Kill() override {
    for (const auto& s : servers_) {
      if (!s->thread.joinable()) continue;
      s->fake->Cancel();
      s->thread.join();
      ++killed;
    }
  }
  int killed = 0;

 private:
  struct Server {
    RegionId region = kNoRegion;
    uint64_t incarnation = 1;
    std::unique_ptr<FakeRegion> fake;
    std::thread thread;
    int exit = 0;
    std::atomic<bool> ended = false;
  };
  const FakeBehaviour behaviour_;
  std::vector<std::unique_ptr<Server>> servers_;
};

class RunTest : public Test {
 protected:
  RunTest() {
    options_.regions = 3;
    options_.no_real_time = true;
    options_.last_tick = 650;
    options_.hash_every = 100;
  }
  absl::Status RunFakes(
      FakeBehaviour behaviour, RunObserver observe = [](const RunStatus&) { return true; }) {
    FakeAllocator allocator(std::move(behaviour));
    const absl::Status s = RunWorld(options_, allocator, observe, &result_);
    EXPECT_EQ(allocator.running(), 0);
    killed_ = allocator.killed;
    return s;
  }
  RunOptions options_;
  RunResult result_;
  int killed_ = 0;
};

TEST_F(RunTest, HashesAndBodiesOfAllRegionsAddUp) {
  ASSERT_TRUE(RunFakes({}).ok());
  EXPECT_EQ(result_.status.stage, Stage::kFinished);
  ASSERT_EQ(result_.hashes.size(), 7u);  // every 100th tick and the last
  for (const TickSum& sum : result_.hashes) {
    EXPECT_EQ(sum.hash, FakeHash(sum.tick));
    EXPECT_EQ(sum.bodies, kFakeBodies);
    EXPECT_EQ(sum.regions, 3);
  }
  EXPECT_EQ(result_.hashes.back().tick, 650);
  EXPECT_EQ(result_.status.MinTick(), 650);
  EXPECT_EQ(result_.status.Bodies(), kFakeBodies);
  ASSERT_EQ(result_.windows.size(), 3u);
  EXPECT_EQ(result_.windows[2].size(), 2u);
  EXPECT_EQ(killed_, 0);
}

TEST_F(RunTest, UndividedRunHasOneServer) {
  options_.undivided = true;
  ASSERT_TRUE(RunFakes({}).ok());
  EXPECT_EQ(result_.status.regions.size(), 1u);
  EXPECT_EQ(result_.hashes.back().hash, FakeHash(650));
}

TEST_F(RunTest, ObserverSeesTheRunAndEndsIt) {
  options_.last_tick = 0;
  options_.no_real_time = false;
  int calls = 0;
  const absl::Status s = RunFakes({}, [&calls](const RunStatus& status) {
    ++calls;
    return status.MinTick() < 50;
  });
  EXPECT_TRUE(absl::IsCancelled(s)) << s;
  EXPECT_GT(calls, 1);
  EXPECT_GE(result_.status.MinTick(), 50);
}

TEST_F(RunTest, ServerThatDiesFailsTheRunByName) {
  FakeBehaviour behaviour;
  behaviour.die_at = 100;
  behaviour.fail_region = 1;
  const absl::Status s = RunFakes(behaviour);
  EXPECT_TRUE(absl::IsAborted(s)) << s;
  EXPECT_NE(s.message().find("region 1 ended: exit status 3"), std::string::npos) << s;
  EXPECT_NE(s.message().find("its last words"), std::string::npos) << s;
}

TEST_F(RunTest, GoodbyeOfAServerIsPartOfTheMessage) {
  FakeBehaviour behaviour;
  behaviour.goodbye = "no room";
  behaviour.fail_region = 2;
  const absl::Status s = RunFakes(behaviour);
  EXPECT_TRUE(absl::IsAborted(s)) << s;
  EXPECT_NE(s.message().find("region 2"), std::string::npos) << s;
  EXPECT_NE(s.message().find("no room"), std::string::npos) << s;
}

TEST_F(RunTest, ServerThatIsNeverReadyIsNamedAfterTheTimeout) {
  FakeBehaviour behaviour;
  behaviour.never_ready = true;
  behaviour.fail_region = 2;
  options_.join_timeout = std::chrono::seconds(1);
  const absl::Status s = RunFakes(behaviour);
  EXPECT_TRUE(absl::IsDeadlineExceeded(s)) << s;
  EXPECT_NE(s.message().find("region 2 loads the world"), std::string::npos) << s;
}

TEST_F(RunTest, ServerThatIgnoresStopIsKilledAndCounted) {
  FakeBehaviour behaviour;
  behaviour.ignore_stop = true;
  behaviour.fail_region = 0;
  options_.stop_timeout = std::chrono::seconds(1);
  const absl::Status s = RunFakes(behaviour);
  EXPECT_TRUE(absl::IsDeadlineExceeded(s)) << s;
  EXPECT_NE(s.message().find("1 servers did not end within 1 s"), std::string::npos) << s;
  EXPECT_EQ(killed_, 1);
}

TEST_F(RunTest, OtherProtocolVersionIsRefusedWithBoth) {
  FakeBehaviour behaviour;
  behaviour.protocol_version = 7;
  const absl::Status s = RunFakes(behaviour);
  EXPECT_TRUE(absl::IsAborted(s)) << s;
}

TEST_F(RunTest, PortInUseIsSaid) {
  grpc::ServerBuilder builder;
  int port = 0;
  builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
  const std::unique_ptr<grpc::Server> other = builder.BuildAndStart();
  options_.listen = "127.0.0.1:" + std::to_string(port);
  const absl::Status s = RunFakes({});
  EXPECT_TRUE(absl::IsUnavailable(s)) << s;
  EXPECT_NE(s.message().find(options_.listen), std::string::npos) << s;
}

// A client that says things in the wrong order.
class ServiceTest : public Test {
 protected:
  ServiceTest() : service_(Plan()) {
    grpc::ServerBuilder builder;
    int port = 0;
    builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
    builder.RegisterService(&service_);
    server_ = builder.BuildAndStart();
    stub_ = v1::Control::NewStub(
        grpc::CreateChannel("127.0.0.1:" + std::to_string(port), grpc::InsecureChannelCredentials()));
  }
  ~ServiceTest() override { server_->Shutdown(std::chrono::system_clock::now()); }

  static RunPlan Plan() {
    RunPlan plan;
    plan.regions = {{.token = "a"}, {.token = "b"}};
    return plan;
  }
  static v1::FromRegion Hello(const std::string& token) {
    v1::FromRegion m;
    m.mutable_hello()->set_protocol_version(kControlProtocolVersion);
    m.mutable_hello()->set_token(token);
    m.mutable_hello()->set_endpoint("127.0.0.1:1");
    return m;
  }
  // How the stream ends after these messages.
  grpc::Status Say(const std::vector<v1::FromRegion>& messages) {
    grpc::ClientContext context;
    const auto stream = stub_->Join(&context);
    for (const v1::FromRegion& m : messages) stream->Write(m);
    v1::ToRegion answer;
    while (stream->Read(&answer)) {
    }
    return stream->Finish();
  }
  ControlService service_;
  std::unique_ptr<grpc::Server> server_;
  std::unique_ptr<v1::Control::Stub> stub_;
};

TEST_F(ServiceTest, StrangeTokenIsRefused) {
  const grpc::Status s = Say({Hello("c")});
  EXPECT_EQ(s.error_code(), grpc::StatusCode::UNAUTHENTICATED);
  EXPECT_EQ(s.error_message(), "hello.token: is not one of this run, or of a server that has been replaced");
  EXPECT_FALSE(service_.Status().regions[0].joined);
}

TEST_F(ServiceTest, TokenCountsOnce) {
  grpc::ClientContext context;
  const auto first = stub_->Join(&context);
  first->Write(Hello("a"));
  while (!service_.Status().regions[0].joined) service_.Wait(std::chrono::milliseconds(100));
  EXPECT_EQ(Say({Hello("a")}).error_code(), grpc::StatusCode::ALREADY_EXISTS);
  EXPECT_FALSE(service_.Status().regions[0].left);
  context.TryCancel();
  first->Finish();
}

TEST_F(ServiceTest, ReportBeforeHelloOrStartIsRefused) {
  v1::FromRegion report;
  report.mutable_report()->set_tick(1);
  EXPECT_EQ(Say({report}).error_message(), "the first message must be a Hello");
  EXPECT_EQ(Say({Hello("b"), report}).error_message(), "a Report before the Start");
}

TEST_F(ServiceTest, ServerThatJoinsAgainMustRunWhatItsTokenIsFor) {
  v1::FromRegion again = Hello("a");
  v1::Running* running = again.mutable_hello()->mutable_running();
  running->set_region(1);
  running->set_incarnation(1);
  running->set_world_hash(WorldHash(Plan().world));
  EXPECT_EQ(Say({again}).error_message(),
            "hello.running: is incarnation 1 of region 1, its token is of incarnation 1 of region 0");
  running->set_region(0);
  running->set_incarnation(2);
  EXPECT_EQ(Say({again}).error_code(), grpc::StatusCode::FAILED_PRECONDITION);
  running->set_incarnation(1);
  running->set_world_hash(17);
  EXPECT_EQ(Say({again}).error_message(), "hello.running.world_hash: is of another world");
  EXPECT_FALSE(service_.Status().regions[0].joined);
}

TEST_F(ServiceTest, ServerThatJoinsAgainIsReadyAndHearsWhereItsPeersAre) {
  grpc::ClientContext first_context, second_context;
  const auto first = stub_->Join(&first_context);
  first->Write(Hello("a"));
  v1::FromRegion again = Hello("b");
  v1::Running* running = again.mutable_hello()->mutable_running();
  running->set_region(1);
  running->set_incarnation(1);
  running->set_world_hash(WorldHash(Plan().world));
  running->set_start_unix_us(1234);
  running->set_tick(70);
  while (!service_.Status().regions[0].joined) service_.Wait(std::chrono::milliseconds(100));
  const auto second = stub_->Join(&second_context);
  second->Write(again);
  v1::ToRegion heard;
  ASSERT_TRUE(second->Read(&heard));
  EXPECT_EQ(heard.peer_moved().region(), 0);
  EXPECT_EQ(heard.peer_moved().endpoint(), "127.0.0.1:1");
  const RunStatus status = service_.Status();
  EXPECT_TRUE(status.regions[1].ready);
  EXPECT_EQ(status.regions[1].report.tick(), 70);
  EXPECT_EQ(status.start_unix_us, 1234) << "the world runs";
  service_.Close();
  EXPECT_EQ(first->Finish().error_code(), grpc::StatusCode::UNAVAILABLE);
  EXPECT_EQ(second->Finish().error_code(), grpc::StatusCode::UNAVAILABLE);
}

TEST(ControlHub, FindsTheWorldOfACallOrTellsItToComeAgain) {
  ControlHub hub;
  grpc::ServerBuilder builder;
  int port = 0;
  builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
  builder.RegisterService(&hub);
  const std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
  const auto stub = v1::Control::NewStub(
      grpc::CreateChannel("127.0.0.1:" + std::to_string(port), grpc::InsecureChannelCredentials()));
  const auto join = [&](const std::string& world) {
    grpc::ClientContext context;
    if (!world.empty()) context.AddMetadata(kWorldMetadata, world);
    const auto stream = stub->Join(&context);
    v1::FromRegion hello;
    hello.mutable_hello()->set_protocol_version(kControlProtocolVersion);
    hello.mutable_hello()->set_endpoint("127.0.0.1:1");
    hello.mutable_hello()->set_token("not this");
    stream->Write(hello);
    v1::ToRegion answer;
    while (stream->Read(&answer)) {
    }
    return stream->Finish();
  };
  ControlService one{RunPlan()}, two{RunPlan()};
  hub.Add("one", {&one, nullptr, ""});
  hub.Add("two", {&two, nullptr, ""});
  EXPECT_EQ(join("one").error_code(), grpc::StatusCode::UNAUTHENTICATED) << "it reached the run";
  EXPECT_EQ(join("two").error_code(), grpc::StatusCode::UNAUTHENTICATED);
  EXPECT_EQ(join("three").error_message(), "aureole-world: no world 'three' runs here now; come again");
  EXPECT_EQ(join("").error_code(), grpc::StatusCode::UNAVAILABLE);
  hub.Remove("two");
  EXPECT_EQ(join("two").error_code(), grpc::StatusCode::UNAVAILABLE);
  server->Shutdown(std::chrono::system_clock::now());
}

TEST(ControlHub, OperatorsNameTheWorldTheyMean) {
  const std::vector<double> edges = {0};
  World one{*Layout::Columns({})}, two{*Layout::Columns(edges)};
  one.name = "first";
  two.name = "second";
  LayoutDesk one_desk(one), two_desk(two);
  EventLog one_log, two_log;
  const auto status = [] { return RunStatus(); };
  CheckpointDesk checkpoints(0, 16000);
  ControlPlaneService one_operators(one_desk, one_log, checkpoints, status);
  ControlPlaneService two_operators(two_desk, two_log, checkpoints, status);
  ControlService servers{RunPlan()};
  two_log.Add({std::chrono::system_clock::now(), v1::ControlEvent::REGION_LEFT, 0, "of two"});
  ControlHub hub;
  grpc::ServerBuilder builder;
  int port = 0;
  builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
  builder.RegisterService(&hub.operators());
  const std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
  const auto stub = v1::ControlPlane::NewStub(
      grpc::CreateChannel("127.0.0.1:" + std::to_string(port), grpc::InsecureChannelCredentials()));
  // The name of the world that answers, or the refusal.
  const auto name = [&](const std::string& world) {
    grpc::ClientContext context;
    if (!world.empty()) context.AddMetadata(kWorldMetadata, world);
    v1::ControlledWorld out;
    const grpc::Status s = stub->GetWorld(&context, {}, &out);
    return s.ok() ? out.name() : s.error_message();
  };
  const auto events = [&](const std::string& world, grpc::Status* s) {
    grpc::ClientContext context;
    context.AddMetadata(kWorldMetadata, world);
    const auto stream = stub->WatchEvents(&context, {});
    std::string out;
    for (v1::ControlEvent event; stream->Read(&event);) out += event.text();
    *s = stream->Finish();
    return out;
  };
  EXPECT_EQ(name("x"), "NO_SUCH_WORLD aureole-world: must name a world that runs here, is 'x'; none runs here now");
  hub.Add("x", {&servers, &one_operators, "first"});
  hub.Add("y", {&servers, &two_operators, "second"});
  hub.Add("z", {&servers, nullptr, ""});
  EXPECT_EQ(name("x"), "first");
  EXPECT_EQ(name("y"), "second");
  EXPECT_EQ(name(""), "MISSING aureole-world: must be in the metadata, and name a world; here run: x, y");
  EXPECT_EQ(name("z"), "NO_SUCH_WORLD aureole-world: must name a world that runs here, is 'z'; here run: x, y");
  grpc::Status s;
  EXPECT_EQ(events("y", &s), "of two");
  EXPECT_TRUE(s.ok()) << s.error_message();
  EXPECT_EQ(events("x", &s), "");
  EXPECT_TRUE(s.ok()) << s.error_message();
  events("w", &s);
  EXPECT_EQ(s.error_code(), grpc::StatusCode::NOT_FOUND);
  grpc::ClientContext context;
  context.AddMetadata(kWorldMetadata, "y");
  v1::ResizeLayoutRequest request;
  request.set_columns(3);
  v1::ResizeLayoutResponse response;
  EXPECT_TRUE(stub->ResizeLayout(&context, request, &response).ok());
  EXPECT_TRUE(one_desk.wanted().empty());
  EXPECT_EQ(two_desk.wanted().size(), 3u);
  hub.Remove("y");
  EXPECT_EQ(name("y"), "NO_SUCH_WORLD aureole-world: must name a world that runs here, is 'y'; here run: x");
  server->Shutdown(std::chrono::system_clock::now());
}

TEST_F(ServiceTest, OldProtocolIsToldWhichOneIsSpoken) {
  v1::FromRegion hello = Hello("a");
  hello.mutable_hello()->set_protocol_version(9);
  const grpc::Status s = Say({hello});
  EXPECT_EQ(s.error_code(), grpc::StatusCode::FAILED_PRECONDITION);
  EXPECT_NE(s.error_message().find("is 9, must be 1"), std::string::npos) << s.error_message();
}

}  // namespace
}  // namespace aureole
