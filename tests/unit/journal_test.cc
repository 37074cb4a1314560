#include "server/region/journal.h"

#include <signal.h>
#include <stdlib.h>
#include <sys/resource.h>

#include <fstream>
#include <thread>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace aureole {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

constexpr uint64_t kWorld = 0xABC;

Checkpoint CheckpointOf(Tick n, std::string state = "some state") {
  Checkpoint c{kWorld, 2, n, std::move(state), {}, {{n - 1, 77, 5}}};
  c.links[0] = {1, 10, 8, {std::make_shared<const std::string>("a frame"), std::make_shared<const std::string>("")}};
  c.links[5].epoch = 4;
  return c;
}

Input Push(uint64_t sequence) {
  Input i;
  i.source = 9;
  i.sequence = sequence;
  i.body = 4;
  return i;
}

class JournalTest : public testing::Test {
 protected:
  JournalTest() {
    std::string name = (fs::temp_directory_path() / "journal-test-XXXXXX").string();
    EXPECT_NE(mkdtemp(name.data()), nullptr);
    directory_ = name;
  }
  ~JournalTest() override { fs::remove_all(directory_); }

  std::unique_ptr<Journal> Open() {
    absl::StatusOr<std::unique_ptr<Journal>> j = Journal::Open(directory_ / "region-2", ++incarnation_);
    EXPECT_TRUE(j.ok()) << j.status();
    return j.ok() ? *std::move(j) : nullptr;
  }
  // Of a new process.
  absl::StatusOr<Journal::Recovered> Recover(RegionId region = 2, uint64_t world = kWorld) {
    return Open()->Recover(world, region, {});
  }
  static void WriteAndWait(Journal* j, Checkpoint c) {
    j->Write(std::move(c));
    while (j->writing()) std::this_thread::yield();
  }
  static std::vector<uint64_t> SequencesOf(const Journal::Recovered& r) {
    std::vector<uint64_t> out;
    for (const LoggedInput& l : r.inputs) out.push_back(l.input.sequence);
    return out;
  }
  std::vector<fs::path> Logs() const {
    std::vector<fs::path> out;
    for (const auto& e : fs::recursive_directory_iterator(directory_ / "region-2")) {
      if (e.path().filename().string().starts_with("inputs-")) out.push_back(e.path());
    }
    std::sort(out.begin(), out.end());
    return out;
  }

  fs::path Checkpoint() const { return directory_ / "region-2" / ("i" + std::to_string(incarnation_)) / "checkpoint"; }
  // What is there now, to be had again.
  void Keep() { fs::copy(directory_ / "region-2", directory_ / "kept", fs::copy_options::recursive); }
  void Restore() {
    fs::remove_all(directory_ / "region-2");
    fs::copy(directory_ / "kept", directory_ / "region-2", fs::copy_options::recursive);
    incarnation_ = 1;
  }

  fs::path directory_;
  uint64_t incarnation_ = 0;  // the newest
};

TEST_F(JournalTest, NextIncarnationFindsTheCheckpointAndTheInputsAfterIt) {
  {
    const auto j = Open();
    ASSERT_TRUE(j->Begin(CheckpointOf(0)).ok());
    j->Log(3, {Push(1), Push(2)});
    ASSERT_TRUE(j->AwaitLogged().ok());
    WriteAndWait(j.get(), CheckpointOf(3));
    EXPECT_EQ(j->TakeDurable(), (Journal::Used{{0, {1, 10}}, {5, {4, 0}}}));
    EXPECT_EQ(j->TakeDurable(), std::nullopt);
    j->Log(4, {Push(3)});
    j->Log(6, {Push(4)});
    ASSERT_TRUE(j->AwaitLogged().ok());
  }
  const absl::StatusOr<Journal::Recovered> found = Recover();
  ASSERT_TRUE(found.ok()) << found.status();
  EXPECT_EQ(found->checkpoint.tick, 3);
  EXPECT_EQ(found->checkpoint.state, "some state");
  EXPECT_EQ(found->checkpoint.links.at(0).applied, 10);
  EXPECT_EQ(found->checkpoint.links.at(0).first, 8);
  EXPECT_EQ(*found->checkpoint.links.at(0).kept.at(0), "a frame");
  EXPECT_EQ(found->checkpoint.hashes.at(0).hash, 77);
  EXPECT_EQ(SequencesOf(*found), (std::vector<uint64_t>{3, 4}));
  EXPECT_EQ(found->inputs[1].tick, 6);
  EXPECT_EQ(found->inputs[1].input.body, 4);
}

TEST_F(JournalTest, LogIsNoLongerThanTheCheckpointsNeed) {
  const auto j = Open();
  ASSERT_TRUE(j->Begin(CheckpointOf(0)).ok());
  for (Tick n = 1; n <= 50; ++n) {
    j->Log(n + 1, {Push(static_cast<uint64_t>(n))});
    ASSERT_TRUE(j->AwaitLogged().ok());
    if (n % 5 == 0) WriteAndWait(j.get(), CheckpointOf(n));
  }
  EXPECT_LE(Logs().size(), 3);
  EXPECT_EQ(SequencesOf(*Recover()), (std::vector<uint64_t>{50}));
}

// A process may end while it writes: what was not yet durable was not told to anybody.
TEST_F(JournalTest, TornRecordAtTheEndIsNoInput) {
  {
    const auto j = Open();
    ASSERT_TRUE(j->Begin(CheckpointOf(0)).ok());
    j->Log(1, {Push(1), Push(2)});
    ASSERT_TRUE(j->AwaitLogged().ok());
  }
  Keep();
  const uintmax_t size = fs::file_size(Logs().at(0));
  for (uintmax_t cut = 1; cut < size / 2; cut += 7) {
    Restore();
    fs::resize_file(Logs().at(0), size - cut);
    EXPECT_EQ(SequencesOf(*Recover()), (std::vector<uint64_t>{1})) << cut;
  }
}

TEST_F(JournalTest, DamageIsFoundAndNamed) {
  {
    const auto j = Open();
    ASSERT_TRUE(j->Begin(CheckpointOf(0)).ok());
    j->Log(1, {Push(1)});
    ASSERT_TRUE(j->AwaitLogged().ok());
    j->Write(CheckpointOf(0));  // the next input goes to another file
    while (j->writing()) std::this_thread::yield();
    j->Log(2, {Push(2)});
    ASSERT_TRUE(j->AwaitLogged().ok());
  }
  const auto flip = [](const fs::path& path, int at) {
    std::fstream file(path, std::ios::in | std::ios::out | std::ios::binary);
    file.seekg(at);
    const char old = static_cast<char>(file.get());
    file.seekp(at);
    file.put(static_cast<char>(old ^ 1));
  };
  Keep();
  ASSERT_TRUE(Recover().ok());
  Restore();
  flip(Logs().at(0), 20);
  const absl::Status s = Recover().status();
  EXPECT_EQ(s.code(), absl::StatusCode::kDataLoss);
  EXPECT_THAT(std::string(s.message()), HasSubstr("inputs-1-0: the log of inputs is damaged"));
  for (int at = 0;; at += 3) {
    Restore();
    if (at >= static_cast<int>(fs::file_size(Checkpoint()))) break;
    flip(Checkpoint(), at);
    EXPECT_EQ(Recover().status().code(), absl::StatusCode::kDataLoss) << at;
  }
  ASSERT_TRUE(Recover().ok());
  fs::resize_file(Checkpoint(), 5);
  EXPECT_THAT(std::string(Recover().status().message()), HasSubstr("has only 5 bytes"));
}

TEST_F(JournalTest, CheckpointOfAnotherWorldOrRegionIsRefused) {
  ASSERT_TRUE(Open()->Begin(CheckpointOf(0)).ok());
  EXPECT_EQ(Recover(3).status().code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(std::string(Recover(2, 1).status().message()),
              HasSubstr("is of region 2 of world 0000000000000abc, not of region 2 of world 0000000000000001"));
}

TEST_F(JournalTest, NewWorldForgetsWhatWasThere) {
  {
    const auto j = Open();
    ASSERT_TRUE(j->Begin(CheckpointOf(0)).ok());
    j->Log(9, {Push(1)});
    ASSERT_TRUE(j->AwaitLogged().ok());
    ASSERT_TRUE(j->Begin(CheckpointOf(0)).ok());
  }
  EXPECT_TRUE(Recover()->inputs.empty());
}

TEST_F(JournalTest, StaleVolumeIsRefusedAndLeftAlone) {
  ASSERT_TRUE(Open()->Begin(CheckpointOf(40)).ok());
  const fs::path checkpoint = Checkpoint();
  incarnation_ = 3;
  const absl::Status old = Open()->Recover(kWorld, 2, {2, 0}).status();
  EXPECT_EQ(old.code(), absl::StatusCode::kFailedPrecondition) << old;
  EXPECT_THAT(std::string(old.message()), HasSubstr("/i1 is stale: incarnation 2 has gone on elsewhere"));
  EXPECT_TRUE(fs::exists(checkpoint));
  const absl::Status lacking = Open()->Recover(kWorld, 2, {1, 41}).status();
  EXPECT_EQ(lacking.code(), absl::StatusCode::kFailedPrecondition) << lacking;
  EXPECT_THAT(std::string(lacking.message()),
              HasSubstr("is of tick 40, and what was not logged here is as late as 41"));
  EXPECT_TRUE(Open()->Recover(kWorld, 2, {1, 40}).ok());
}

TEST_F(JournalTest, WhatWasRecoveredElsewhereReplacesWhatIsHere) {
  {
    const auto j = Open();
    ASSERT_TRUE(j->Begin(CheckpointOf(40)).ok());
    j->Log(41, {Push(1)});
    ASSERT_TRUE(j->AwaitLogged().ok());
  }
  {
    const auto j = Open();
    ASSERT_TRUE(j->Adopt({CheckpointOf(80), {{81, Push(2)}, {83, Push(3)}}}).ok());
    j->Log(84, {Push(4)});
    ASSERT_TRUE(j->AwaitLogged().ok());
  }
  const absl::StatusOr<Journal::Recovered> found = Recover();
  ASSERT_TRUE(found.ok()) << found.status();
  EXPECT_EQ(found->checkpoint.tick, 80);
  EXPECT_EQ(SequencesOf(*found), (std::vector<uint64_t>{2, 3, 4}));
}

// A keeper goes on with what it has, again and again, also as the same incarnation.
TEST_F(JournalTest, JournalThatContinuesKeepsAllUntilTheNextCheckpoint) {
  {
    const auto j = Open();
    EXPECT_TRUE(j->Continue().ok()) << "nothing is there";
    j->WriteEncoded(5, EncodeCheckpoint(CheckpointOf(5)));
    while (j->writing()) std::this_thread::yield();
  }
  for (Tick n = 6; n < 12; ++n) {
    if (n % 2 == 0) --incarnation_;
    const auto j = Open();
    ASSERT_TRUE(j->Continue().ok());
    // The last that was there is said again, after the connection was lost.
    for (Tick again = n - (n > 6 ? 1 : 0); again <= n; ++again) {
      j->LogRecords(again, EncodeInputs({{again, Push(static_cast<uint64_t>(again))}}));
      ASSERT_TRUE(j->AwaitLogged().ok());
    }
    EXPECT_LE(Logs().size(), 2);
  }
  Keep();
  EXPECT_EQ(SequencesOf(*Recover()), (std::vector<uint64_t>{6, 7, 8, 9, 10, 11}));
  const auto j = Open();
  ASSERT_TRUE(j->Continue().ok());
  j->WriteEncoded(12, EncodeCheckpoint(CheckpointOf(12)));
  while (j->writing()) std::this_thread::yield();
  EXPECT_TRUE(Recover()->inputs.empty());
}

TEST_F(JournalTest, DamagedCopyIsNoReasonNotToBeginAnother) {
  {
    const auto j = Open();
    ASSERT_TRUE(j->Begin(CheckpointOf(0)).ok());
    j->Log(1, {Push(1)});
    ASSERT_TRUE(j->AwaitLogged().ok());
    WriteAndWait(j.get(), CheckpointOf(0));
    j->Log(2, {Push(2)});
    ASSERT_TRUE(j->AwaitLogged().ok());
  }
  std::fstream(Logs().at(0), std::ios::in | std::ios::out | std::ios::binary).seekp(20).put('\x55');
  ASSERT_EQ(Open()->Recover(kWorld, 2, {}).status().code(), absl::StatusCode::kDataLoss);
  const auto j = Open();
  ASSERT_TRUE(j->Continue().ok());
  j->WriteEncoded(7, EncodeCheckpoint(CheckpointOf(7)));
  while (j->writing()) std::this_thread::yield();
  EXPECT_EQ(Recover()->checkpoint.tick, 7);
}

// It may still run where nobody can end it, on a machine that is cut off.
TEST_F(JournalTest, IncarnationThatWasTakenOverMakesNothingDurable) {
  const auto old = Open();
  ASSERT_TRUE(old->Begin(CheckpointOf(0)).ok());
  old->Log(1, {Push(1)});
  ASSERT_TRUE(old->AwaitLogged().ok());
  EXPECT_FALSE(old->fenced());
  const auto next = Open();
  EXPECT_EQ(SequencesOf(*next->Recover(kWorld, 2, {})), (std::vector<uint64_t>{1}));
  old->Log(2, {Push(2)});
  const absl::Status s = old->AwaitLogged();
  EXPECT_EQ(s.code(), absl::StatusCode::kAborted) << s;
  EXPECT_TRUE(old->fenced());
  WriteAndWait(old.get(), CheckpointOf(9));
  EXPECT_EQ(old->TakeDurable(), std::nullopt);
  next->Log(2, {Push(3)});
  ASSERT_TRUE(next->AwaitLogged().ok());
  const auto third = Open();
  const absl::StatusOr<Journal::Recovered> found = third->Recover(kWorld, 2, {});
  EXPECT_EQ(found->checkpoint.tick, 0);
  EXPECT_EQ(SequencesOf(*found), (std::vector<uint64_t>{1, 3})) << "nothing of what the first wrote too late";
}

TEST_F(JournalTest, IncarnationThatWasTakenOverSeesItAtACheckpoint) {
  const auto old = Open();
  ASSERT_TRUE(old->Begin(CheckpointOf(0)).ok());
  ASSERT_TRUE(Recover().ok());
  WriteAndWait(old.get(), CheckpointOf(9));
  EXPECT_TRUE(old->fenced());
  EXPECT_EQ(Recover()->checkpoint.tick, 0);
}

TEST_F(JournalTest, EarlierIncarnationThatComesLateIsRefused) {
  const auto late = Open();
  ASSERT_TRUE(Open()->Begin(CheckpointOf(0)).ok());
  EXPECT_EQ(late->Recover(kWorld, 2, {}).status().code(), absl::StatusCode::kAborted);
  EXPECT_EQ(late->Begin(CheckpointOf(0)).code(), absl::StatusCode::kAborted);
}

TEST_F(JournalTest, WhereNothingCanBeWrittenIsSaid) {
  std::ofstream(directory_ / "file") << "x";
  const absl::Status s = Journal::Open(directory_ / "file", 1).status();
  EXPECT_EQ(s.code(), absl::StatusCode::kUnavailable) << s;
  EXPECT_THAT(std::string(s.message()), HasSubstr((directory_ / "file").string()));
}

// A limit on the size of files stands in for a disk that is full.
TEST_F(JournalTest, FullDiskIsCountedAndTheLastCheckpointStays) {
  const auto j = Open();
  ASSERT_TRUE(j->Begin(CheckpointOf(0)).ok());
  WriteAndWait(j.get(), CheckpointOf(7));
  rlimit before{};
  ASSERT_EQ(getrlimit(RLIMIT_FSIZE, &before), 0);
  signal(SIGXFSZ, SIG_IGN);
  const rlimit small{50, before.rlim_max};
  ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &small), 0);
  WriteAndWait(j.get(), CheckpointOf(8));
  j->Log(8, {Push(1)});
  const absl::Status logged = j->AwaitLogged();
  ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &before), 0);
  EXPECT_EQ(logged.code(), absl::StatusCode::kUnavailable) << logged;
  EXPECT_EQ(j->stats().failures, 2);
  EXPECT_THAT(j->stats().last_failure, HasSubstr("cannot write"));
  EXPECT_EQ(j->stats().durable_tick, 7);
  Keep();
  const auto copy = Journal::Open(directory_ / "kept", 2);
  EXPECT_EQ((*copy)->Recover(kWorld, 2, {})->checkpoint.tick, 7);

  j->Log(9, {Push(2)});
  EXPECT_TRUE(j->AwaitLogged().ok());
  WriteAndWait(j.get(), CheckpointOf(8));
  EXPECT_EQ(j->stats().durable_tick, 8);
  EXPECT_EQ(j->stats().last_failure, "");
  EXPECT_EQ(SequencesOf(*Recover()), (std::vector<uint64_t>{2}));
}

}  // namespace
}  // namespace aureole
