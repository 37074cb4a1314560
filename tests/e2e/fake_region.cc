#include "tests/e2e/fake_region.h"

#include <unistd.h>

#include <algorithm>
#include <thread>

namespace aureole {
namespace {

constexpr int64_t kTicksPerReport = 25;
constexpr int64_t kTicksPerWindow = 312;

void SetFrame(v1::FrameTime* frame, int64_t ticks, double ms) {
  frame->set_ticks(ticks);
  frame->set_mean_ms(ms / 2);
  frame->set_p99_ms(ms * 0.9);
  frame->set_max_ms(ms);
}

}  // namespace

uint64_t FakeHash(int64_t tick) { return 0x9e3779b97f4a7c15ULL * static_cast<uint64_t>(tick + 1); }

FakeRegion::FakeRegion(std::string control, std::string token, FakeBehaviour behaviour)
    : control_(std::move(control)), token_(std::move(token)), behaviour_(std::move(behaviour)) {}

void FakeRegion::Cancel() {
  cancelled_ = true;
  context_.TryCancel();
}

bool FakeRegion::Misbehaves(const v1::Assignment& assignment) const {
  return behaviour_.fail_region < 0 || behaviour_.fail_region == assignment.region();
}

int FakeRegion::Run() {
  const auto channel = grpc::CreateChannel(control_, grpc::InsecureChannelCredentials());
  const auto stub = v1::Control::NewStub(channel);
  context_.set_wait_for_ready(true);
  stream_ = stub->Join(&context_);
  v1::FromRegion hello;
  hello.mutable_hello()->set_protocol_version(behaviour_.protocol_version);
  hello.mutable_hello()->set_token(token_);
  hello.mutable_hello()->set_endpoint("127.0.0.1:1");
  hello.mutable_hello()->set_pid(getpid());
  stream_->Write(hello);
  v1::ToRegion message;
  v1::Assignment assignment;
  std::thread simulation;
  while (stream_->Read(&message)) {
    if (message.has_assignment()) {
      assignment = message.assignment();
      if (behaviour_.never_ready && Misbehaves(assignment)) continue;
      v1::FromRegion ready;
      ready.mutable_ready()->set_bodies(kFakeBodies / assignment.endpoints_size());
      stream_->Write(ready);
    } else if (message.has_start()) {
      simulation = std::thread([this, assignment] { Simulate(assignment); });
    } else if (message.has_stop() && !(behaviour_.ignore_stop && Misbehaves(assignment))) {
      break;
    }
  }
  stopped_ = true;
  if (simulation.joinable()) simulation.join();
  if (exit_ == 0) stream_->WritesDone();
  while (stream_->Read(&message)) {
  }
  const grpc::Status status = stream_->Finish();
  if (exit_ == 0 && !status.ok() && !cancelled_) {
    fprintf(stderr, "the control stream ended: %s\n", status.error_message().c_str());
    return 1;
  }
  return exit_;
}

void FakeRegion::Simulate(const v1::Assignment& assignment) {
  const int64_t last = assignment.last_tick();
  const bool misbehaves = Misbehaves(assignment);
  for (int64_t from = 0; !stopped_ && !cancelled_ && (last == 0 || from < last); from += kTicksPerReport) {
    const int64_t to = last == 0 ? from + kTicksPerReport : std::min(last, from + kTicksPerReport);
    if (misbehaves && behaviour_.die_at >= 0 && to >= behaviour_.die_at) {
      fprintf(stderr, "fake: dies at tick %ld\n", static_cast<long>(to));
      exit_ = 3;
      break;
    }
    if (misbehaves && !behaviour_.goodbye.empty()) {
      v1::FromRegion goodbye;
      goodbye.mutable_goodbye()->set_reason(behaviour_.goodbye);
      stream_->Write(goodbye);
      exit_ = 1;
      break;
    }
    v1::FromRegion message;
    *message.mutable_report() = MakeReport(assignment, from, to);
    if (!stream_->Write(message)) return;
    if (!assignment.no_real_time()) usleep(static_cast<useconds_t>(kTicksPerReport * 1000));
  }
  if (exit_ != 0) stream_->WritesDone();
}

v1::Report FakeRegion::MakeReport(const v1::Assignment& assignment, int64_t from, int64_t to) const {
  const int n = assignment.endpoints_size();
  const bool misbehaves = Misbehaves(assignment) && !assignment.undivided();
  v1::Report report;
  report.set_tick(to);
  report.set_bodies(kFakeBodies / n);
  report.set_awake(kFakeBodies / n / 2);
  report.set_real_time_factor(1);
  SetFrame(report.mutable_frame(), to - from, 10.0 / n);
  report.set_auras_told(n > 1 ? 3 : 0);
  report.set_bytes_sent(n > 1 ? to * 30 : 0);
  report.set_transfers(n > 1 ? to / 10 : 0);
  report.set_bodies_moved(n > 1 ? to / 5 : 0);
  report.set_home_crossings(n > 1 ? to / 5 : 0);
  report.set_body_ticks(to * kFakeBodies / n);
  for (int64_t tick = from + 1; tick <= to; ++tick) {
    const bool due =
        assignment.hash_every() > 0 && (tick % assignment.hash_every() == 0 || tick == assignment.last_tick());
    if (due) {
      v1::TickHash* hash = report.add_hashes();
      hash->set_tick(tick);
      // Region 0 makes the sum right.
      const uint64_t other = static_cast<uint64_t>(tick) * 1000;
      const uint64_t others = static_cast<uint64_t>(n - 1) * other;
      hash->set_hash(assignment.region() == 0 ? FakeHash(tick) - others : other);
      hash->set_bodies(kFakeBodies / n);
      hash->set_members(n);
      if (misbehaves && behaviour_.wrong_hash && tick >= 200) hash->set_hash(hash->hash() + 1);
      if (misbehaves && behaviour_.lose_at >= 0 && tick >= behaviour_.lose_at) hash->set_bodies(hash->bodies() - 1);
    }
    if (tick % kTicksPerWindow == 0) {
      v1::Window* window = report.add_windows();
      window->set_index(tick / kTicksPerWindow - 1);
      SetFrame(window->mutable_process_cpu(), kTicksPerWindow, static_cast<double>(tick) / n + assignment.region());
      SetFrame(window->mutable_thread_cpu(), kTicksPerWindow, static_cast<double>(tick) / n);
      SetFrame(window->mutable_wall(), kTicksPerWindow, static_cast<double>(tick) / n);
      window->set_bodies(kFakeBodies / n);
    }
  }
  report.set_finished(to == assignment.last_tick());
  return report;
}

}  // namespace aureole
