// A region's copy: what is shipped to the keeper, when anything depends on it, and what is fetched.
#include <stdlib.h>

#include <chrono>
#include <filesystem>
#include <thread>

#include <gmock/gmock.h>
#include <grpcpp/server_builder.h>
#include <gtest/gtest.h>

#include "server/region/copy_fetch.h"
#include "server/region/copy_keeper.h"
#include "server/region/copy_sender.h"

namespace aureole {
namespace {

namespace fs = std::filesystem;
using std::chrono::milliseconds;
using testing::HasSubstr;

constexpr uint64_t kWorld = 0xABC;

TEST(KeeperOf, IsTheNextMemberInTheirOrder) {
  EXPECT_EQ(KeeperOf(0, {0, 1, 2}), 1);
  EXPECT_EQ(KeeperOf(2, {0, 1, 2}), 0);
  EXPECT_EQ(KeeperOf(1, {0, 1, 4}), 4);
  EXPECT_EQ(KeeperOf(3, {0, 1, 4}), 4) << "one that has left";
  EXPECT_EQ(KeeperOf(5, {0, 1, 4}), 0);
  EXPECT_EQ(KeeperOf(0, {0}), kNoRegion);
}

Checkpoint CheckpointOf(Tick n, size_t bytes = 10) { return {kWorld, 2, n, std::string(bytes, 's'), {}, {}}; }

Input Push(uint64_t sequence) {
  Input i;
  i.source = 9;
  i.sequence = sequence;
  return i;
}

std::vector<uint64_t> SequencesOf(const Journal::Recovered& r) {
  std::vector<uint64_t> out;
  for (const LoggedInput& l : r.inputs) out.push_back(l.input.sequence);
  return out;
}

// A port at which a service is served, and can be taken away.
class Port {
 public:
  void Serve(grpc::Service* service) {
    grpc::ServerBuilder builder;
    builder.AddListeningPort(endpoint_, grpc::InsecureServerCredentials(), &port_);
    builder.RegisterService(service);
    server_ = builder.BuildAndStart();
    ASSERT_NE(server_, nullptr);
    endpoint_ = "127.0.0.1:" + std::to_string(port_);
  }
  void Close() {
    if (server_ != nullptr) server_->Shutdown(std::chrono::system_clock::now());
    server_.reset();
  }
  ~Port() { Close(); }
  const std::string& endpoint() const { return endpoint_; }

 private:
  std::string endpoint_ = "127.0.0.1:0";
  int port_ = 0;
  std::unique_ptr<grpc::Server> server_;
};

// Region 2 and its keeper, region 0.
class CopyTest : public testing::Test {
 protected:
  CopyTest() {
    std::string name = (fs::temp_directory_path() / "copy-test-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
    StartKeeper();
  }
  ~CopyTest() override {
    sender_.reset();
    port_.Close();
    keeper_.reset();
    fs::remove_all(directory_);
  }

  void StartKeeper() {
    keeper_ = std::make_unique<CopyKeeper>(directory_ / "copies");
    keeper_->Serve(kWorld, 0);
    port_.Serve(keeper_.get());
  }
  void EndKeeper() {
    port_.Close();
    keeper_.reset();
  }
  // Of the next incarnation.
  void StartSender(uint64_t world = kWorld, Tick least = 0) {
    sender_ = std::make_unique<CopySender>(CopyIdentity{world, 2, ++incarnation_}, least, [](const std::string&) {});
    sender_->Connect(0, {port_.endpoint()}, grpc::InsecureChannelCredentials());
  }
  template <class Fn>
  static bool Await(Fn&& fn) {
    for (const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(20);
         std::chrono::steady_clock::now() < end; std::this_thread::sleep_for(milliseconds(2))) {
      if (fn()) return true;
    }
    return false;
  }
  // Checkpoints until one of them is copied.
  void Cover(Tick first, size_t bytes = 10) {
    EXPECT_TRUE(Await([&] {
      const CopySender::Stats stats = sender_->stats();
      if (!stats.covers && stats.shipping == 0) {
        sender_->Begin(first, 0);
        sender_->Ship(first, std::make_shared<const std::string>(EncodeCheckpoint(CheckpointOf(first, bytes))));
      }
      return stats.covers;
    })) << sender_->stats().failure;
  }
  bool Copy(Tick n, size_t bytes = 10) {
    sender_->Begin(n, 0);
    sender_->Ship(n, std::make_shared<const std::string>(EncodeCheckpoint(CheckpointOf(n, bytes))));
    return Await([&] { return sender_->stats().tick == n; });
  }
  void Log(Tick n, uint64_t sequence) { sender_->Log(n, EncodeInputs({{n, Push(sequence)}})); }
  absl::StatusOr<Journal::Recovered> Fetch(uint64_t incarnation, uint64_t world = kWorld) {
    return FetchCopy({world, 2, incarnation}, 0, port_.endpoint(), grpc::InsecureChannelCredentials(),
                     std::chrono::seconds(5));
  }

  fs::path directory_;
  std::unique_ptr<CopyKeeper> keeper_;
  Port port_;
  std::unique_ptr<CopySender> sender_;
  uint64_t incarnation_ = 0;
};

TEST_F(CopyTest, CheckpointAndTheInputsAfterItAreFetched) {
  StartSender();
  Cover(40, 3 << 20);
  Log(41, 1);
  sender_->AwaitLogged();
  Log(90, 2);
  sender_->AwaitLogged();
  ASSERT_TRUE(Copy(80, 5 << 20));
  Log(91, 3);
  sender_->AwaitLogged();
  EXPECT_TRUE(sender_->stats().covers) << sender_->stats().failure;
  EXPECT_FALSE(sender_->stats().alone);
  const absl::StatusOr<Journal::Recovered> found = Fetch(2);
  ASSERT_TRUE(found.ok()) << found.status();
  EXPECT_EQ(found->checkpoint.tick, 80);
  EXPECT_EQ(found->checkpoint.state, std::string(5 << 20, 's'));
  EXPECT_EQ(SequencesOf(*found), (std::vector<uint64_t>{2, 3}));
}

// They were offered while nobody covered the region, and are told after the state of the checkpoint.
TEST_F(CopyTest, InputsThatWereLoggedBeforeTheFirstCheckpointAreInTheCopy) {
  StartSender();
  Log(41, 1);
  sender_->AwaitLogged();
  EXPECT_TRUE(sender_->stats().alone);
  EXPECT_EQ(sender_->stats().least_tick, 41);
  Cover(40);
  EXPECT_EQ(sender_->stats().least_tick, 0) << "the copy has it now";
  EXPECT_EQ(SequencesOf(*Fetch(2)), (std::vector<uint64_t>{1}));
}

TEST_F(CopyTest, FramesAreNeededUntilBothHaveTheCheckpoint) {
  StartSender();
  EXPECT_EQ(sender_->MostToForget(20), 20) << "nobody covers it yet";
  EXPECT_EQ(sender_->stats().least_tick, 20);
  Cover(40);
  EXPECT_EQ(sender_->MostToForget(80), 40);
  EXPECT_EQ(sender_->stats().least_tick, 40);
  ASSERT_TRUE(Copy(80));
  EXPECT_EQ(sender_->MostToForget(80), 80);
  EndKeeper();
  ASSERT_TRUE(Await([&] { return !sender_->stats().covers; }));
  EXPECT_EQ(sender_->MostToForget(120), 120);
  EXPECT_EQ(sender_->stats().least_tick, 120);
  EXPECT_THAT(sender_->stats().failure, HasSubstr("its keeper, region 0: "));
  EXPECT_EQ(sender_->stats().failures, 1);
}

TEST_F(CopyTest, FetchFencesTheIncarnationsBefore) {
  StartSender();
  Cover(40);
  Log(41, 1);
  sender_->AwaitLogged();
  EXPECT_FALSE(sender_->fenced());
  EXPECT_EQ(SequencesOf(*Fetch(2)), (std::vector<uint64_t>{1}));
  EXPECT_TRUE(Await([&] { return sender_->fenced(); }));
  Log(42, 2);
  sender_->AwaitLogged();
  EXPECT_EQ(SequencesOf(*Fetch(2)), (std::vector<uint64_t>{1})) << "and may be asked for again";
  EXPECT_EQ(Fetch(1).status().code(), absl::StatusCode::kAborted);
  incarnation_ = 0;
  StartSender(kWorld, 1);  // an earlier one that comes late
  EXPECT_TRUE(Await([&] { return sender_->fenced(); }));
}

TEST_F(CopyTest, KeeperThatComesAgainHasWhatItHadUntilTheNextCheckpoint) {
  StartSender();
  Cover(40);
  Log(41, 1);
  sender_->AwaitLogged();
  EndKeeper();
  ASSERT_TRUE(Await([&] { return !sender_->stats().covers; }));
  StartKeeper();
  Log(61, 2);
  sender_->AwaitLogged();
  EXPECT_EQ(sender_->stats().least_tick, 61) << "this one it does not have";
  Cover(60);
  EXPECT_EQ(sender_->stats().failure, "");
  Log(62, 3);
  sender_->AwaitLogged();
  sender_.reset();
  const absl::StatusOr<Journal::Recovered> found = Fetch(2);
  EXPECT_EQ(found->checkpoint.tick, 60);
  EXPECT_EQ(SequencesOf(*found), (std::vector<uint64_t>{2, 3}));
  // The next incarnation connects, and dies before it has copied anything.
  incarnation_ = 1;
  StartSender(kWorld, 60);
  EXPECT_TRUE(Await([&] { return fs::exists(directory_ / "copies/region-2/i2/inputs-2-0"); }));
  sender_.reset();
  EXPECT_EQ(SequencesOf(*Fetch(3)), (std::vector<uint64_t>{2, 3}));
}

// It has other inputs than what was there before, of the same world, whatever incarnation made it.
TEST_F(CopyTest, RegionThatBeginsWithItsWorldHasNoCopyYet) {
  incarnation_ = 6;
  StartSender();
  Cover(400);
  sender_.reset();
  incarnation_ = 0;
  StartSender();
  ASSERT_TRUE(Await([&] { return !fs::exists(directory_ / "copies/region-2/i7"); }));
  EXPECT_FALSE(sender_->fenced());
  Cover(40);
  EXPECT_EQ(Fetch(2)->checkpoint.tick, 40);
}

TEST_F(CopyTest, CopyOfAnotherWorldIsRefusedAndSaid) {
  StartSender(kWorld + 1);
  sender_->Begin(1, 0);
  EXPECT_TRUE(Await([&] { return !sender_->stats().failure.empty(); }));
  EXPECT_THAT(sender_->stats().failure, HasSubstr("is of another world"));
  EXPECT_EQ(Fetch(2).status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(Fetch(2, kWorld + 1).status().code(), absl::StatusCode::kFailedPrecondition);
}

// Acknowledges checkpoints, and no inputs.
class SlowKeeper final : public v1::Copies::CallbackService {
 public:
  grpc::ServerBidiReactor<v1::KeepMessage, v1::Kept>* Keep(grpc::CallbackServerContext*) override {
    class Stream final : public grpc::ServerBidiReactor<v1::KeepMessage, v1::Kept> {
     public:
      Stream() { StartRead(&in_); }
      void OnReadDone(bool ok) override {
        if (!ok) return Finish(grpc::Status::OK);
        if (in_.part().has_checkpoint()) out_.set_checkpoint_tick(in_.part().tick());
        if (in_.part().has_inputs()) return StartRead(&in_);
        StartWrite(&out_);
      }
      void OnWriteDone(bool ok) override {
        if (ok) StartRead(&in_);
        if (!ok) Finish(grpc::Status::OK);
      }
      void OnDone() override { delete this; }

     private:
      v1::KeepMessage in_;
      v1::Kept out_;
    };
    return new Stream;
  }
};

TEST_F(CopyTest, KeeperThatIsSlowIsWaitedForOnceAndNotLong) {
  EndKeeper();
  SlowKeeper slow;
  port_.Serve(&slow);
  StartSender();
  Cover(40);
  const auto began = std::chrono::steady_clock::now();
  Log(41, 1);
  sender_->AwaitLogged();
  const auto first = std::chrono::steady_clock::now() - began;
  EXPECT_GE(first, CopySender::kLongestLog);
  EXPECT_LT(first, 10 * CopySender::kLongestLog);
  const CopySender::Stats stats = sender_->stats();
  EXPECT_FALSE(stats.covers);
  EXPECT_TRUE(stats.alone);
  EXPECT_EQ(stats.least_tick, 41);
  EXPECT_THAT(stats.failure, HasSubstr("has not made inputs durable within 100 ms"));
  for (Tick n = 42; n < 142; ++n) {
    Log(n, static_cast<uint64_t>(n));
    sender_->AwaitLogged();
  }
  EXPECT_LT(std::chrono::steady_clock::now() - began, 20 * CopySender::kLongestLog) << "a hundred more cost nothing";
  sender_.reset();
  port_.Close();
}

TEST_F(CopyTest, CheckpointThatTakesTooLongIsGivenUp) {
  StartSender();
  Cover(40);
  sender_->Begin(80, 0);  // and is never there whole
  sender_->Begin(120, 0);
  EXPECT_TRUE(sender_->stats().covers);
  EXPECT_EQ(sender_->MostToForget(120), 40);
  sender_->Begin(160, 0);
  EXPECT_FALSE(sender_->stats().covers);
  EXPECT_THAT(sender_->stats().failure, HasSubstr("before two more were made"));
  EXPECT_EQ(sender_->MostToForget(160), 160);
}

TEST_F(CopyTest, NextKeeperGetsAllAnew) {
  CopyKeeper other(directory_ / "other");
  other.Serve(kWorld, 1);
  Port there;
  there.Serve(&other);
  StartSender();
  Cover(40);
  sender_->Redirect(1, there.endpoint(), 1);
  sender_->Begin(80, 1);
  EXPECT_FALSE(sender_->stats().covers);
  EXPECT_EQ(sender_->stats().tick, 0);
  ASSERT_TRUE(Await([&] {
    if (!sender_->stats().covers && sender_->stats().shipping == 0) sender_->Begin(120, 1);
    sender_->Ship(120, std::make_shared<const std::string>(EncodeCheckpoint(CheckpointOf(120))));
    return sender_->stats().covers;
  }));
  sender_.reset();
  const auto found =
      FetchCopy({kWorld, 2, 2}, 1, there.endpoint(), grpc::InsecureChannelCredentials(), std::chrono::seconds(5));
  EXPECT_EQ(found->checkpoint.tick, 120);
  there.Close();
}

TEST_F(CopyTest, JournalTellsOnlyWhatBothHave) {
  StartSender();
  const absl::StatusOr<std::unique_ptr<Journal>> journal = Journal::Open(directory_ / "own", 1);
  ASSERT_TRUE(journal.ok()) << journal.status();
  Journal* const j = journal->get();
  ASSERT_TRUE(j->Begin(CheckpointOf(0)).ok());
  j->CopyTo(sender_.get());
  Cover(10);
  for (Tick n = 20; n <= 60; n += 20) {
    j->Write(CheckpointOf(n), 0);
    EXPECT_TRUE(Await([&] { return sender_->stats().tick == n && j->stats().durable_tick == n; }));
    EXPECT_TRUE(j->TakeDurable().has_value());
    EXPECT_FALSE(j->TakeDurable().has_value());
  }
  j->Log(61, {Push(1)});
  ASSERT_TRUE(j->AwaitLogged().ok());
  EXPECT_TRUE(j->stats().copy.covers);
  EXPECT_EQ(SequencesOf(*Fetch(2)), (std::vector<uint64_t>{1}));
  EXPECT_TRUE(Await([&] { return j->fenced(); }));
}

TEST_F(CopyTest, KeeperThatLosesItsVolumeSaysSoAndBeginsAgain) {
  StartSender();
  Cover(40);
  Log(41, 1);
  sender_->AwaitLogged();
  fs::remove_all(directory_ / "copies");
  Log(42, 2);
  sender_->AwaitLogged();
  EXPECT_TRUE(Await([&] { return !sender_->stats().failure.empty(); }));
  EXPECT_THAT(sender_->stats().failure, HasSubstr(" is gone"));
  EXPECT_EQ(sender_->stats().least_tick, 42);
  Cover(60);
  EXPECT_EQ(Fetch(2)->checkpoint.tick, 60);
}

}  // namespace
}  // namespace aureole
