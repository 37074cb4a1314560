#include "client/cli/load.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <iostream>
#include <limits>
#include <memory>
#include <mutex>
#include <optional>
#include <random>
#include <thread>
#include <vector>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <google/protobuf/io/coded_stream.h>
#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/grpcpp.h>
#include <nlohmann/json.hpp>

#include "aureole/v1/simulation.grpc.pb.h"
#include "client/cli/connect.h"
#include "client/cli/exit_codes.h"
#include "client/cli/flags.h"
#include "client/src/channel.h"
#include "client/src/layout_follower.h"
#include "client/src/replica_decoder.h"
#include "server/control/interrupts.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;
using Json = nlohmann::ordered_json;

constexpr char kMethod[] = "/aureole.v1.Simulation/StreamReplicas";

// A connection of its own for every client, as from machines of their own.
std::shared_ptr<grpc::Channel> Connect(const std::string& endpoint) {
  grpc::ChannelArguments arguments;
  arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);
  arguments.SetMaxReceiveMessageSize(-1);
  return client::ChannelTo(endpoint, GivenAccess(), std::move(arguments));
}

// The first field of a frame is its tick.
int64_t TickOf(const grpc::Slice& frame) {
  google::protobuf::io::CodedInputStream in(frame.begin(), static_cast<int>(frame.size()));
  uint64_t tick = 0;
  const bool first = in.ReadTag() == v1::ReplicaFrame::kTickFieldNumber << 3 && in.ReadVarint64(&tick);
  return first ? static_cast<int64_t>(tick) : 0;
}

// One stream, whose frames are counted and not read.
class Watcher final : public grpc::ClientBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer> {
 public:
  Watcher(const std::string& endpoint, const v1::StreamReplicasRequest& request)
      : stub_(Connect(endpoint)), bytes_of_request_(request.SerializeAsString()), request_(&bytes_of_request_, 1) {
    stub_.PrepareBidiStreamingCall(&context_, kMethod, {}, this);
    StartWriteLast(&request_, {});
    StartRead(&in_);
    StartCall();
  }

  void OnReadDone(bool ok) override {
    if (!ok) return;
    grpc::Slice frame;
    if (!in_.TrySingleSlice(&frame).ok()) in_.DumpToSingleSlice(&frame);
    const Clock::time_point now = Clock::now();
    {
      const std::lock_guard lock(mutex_);
      ++frames_;
      bytes_ += static_cast<int64_t>(frame.size());
      const int64_t tick = TickOf(frame);
      if (last_tick_ > 0) {
        intervals_ms_.push_back(std::chrono::duration<float, std::milli>(now - last_).count());
        ticks_.push_back(static_cast<int32_t>(tick - last_tick_));
      }
      last_tick_ = tick;
      last_ = now;
    }
    StartRead(&in_);
  }
  void OnDone(const grpc::Status& status) override {
    const std::lock_guard lock(mutex_);
    status_ = status;
    done_ = true;
    done_changed_.notify_all();
  }

  // What came until now counts no more.
  void Reset() {
    const std::lock_guard lock(mutex_);
    frames_ = bytes_ = 0;
    intervals_ms_.clear();
    ticks_.clear();
  }
  void End() {
    context_.TryCancel();
    std::unique_lock lock(mutex_);
    done_changed_.wait(lock, [this] { return done_; });
  }

  // After End.
  int64_t frames() const { return frames_; }
  int64_t bytes() const { return bytes_; }
  const std::vector<float>& intervals_ms() const { return intervals_ms_; }
  const std::vector<int32_t>& ticks() const { return ticks_; }
  bool failed() const { return status_.error_code() != grpc::StatusCode::CANCELLED && !status_.ok(); }
  const grpc::Status& status() const { return status_; }

 private:
  grpc::GenericStub stub_;
  grpc::ClientContext context_;
  const grpc::Slice bytes_of_request_;
  const grpc::ByteBuffer request_;
  grpc::ByteBuffer in_;
  std::mutex mutex_;
  std::condition_variable done_changed_;
  Clock::time_point last_;
  int64_t frames_ = 0, bytes_ = 0, last_tick_ = 0;
  std::vector<float> intervals_ms_;
  std::vector<int32_t> ticks_;
  grpc::Status status_;
  bool done_ = false;
};

// Pushes bodies that it sees, at a steady rate, until it is ended.
class Pusher {
 public:
  Pusher(const std::string& endpoint, double rate)
      : rate_(rate), stub_(v1::Simulation::NewStub(Connect(endpoint))), thread_([this] { Run(); }) {}

  v1::ImpulseSummary End() {
    ended_ = true;
    thread_.join();
    return summary_;
  }

 private:
  std::vector<uint64_t> Look() {
    grpc::ClientContext context;
    const auto stream = stub_->StreamReplicas(&context, {});
    v1::ReplicaFrame frame;
    client::ReplicaDecoder decoder(v1::FINE, false);
    std::string error;
    std::vector<uint64_t> ids;
    if (stream->Read(&frame) && decoder.Apply(frame, &error)) decoder.ForEach([&](uint64_t id) { ids.push_back(id); });
    context.TryCancel();
    return ids;
  }

  void Run() {
    const std::vector<uint64_t> ids = Look();
    if (ids.empty()) return;
    std::mt19937_64 random(std::random_device{}());
    std::uniform_real_distribution<double> speed(-1, 1);
    grpc::ClientContext context;
    const auto stream = stub_->ApplyImpulses(&context, &summary_);
    uint64_t sequence = 0;
    const Clock::time_point begin = Clock::now();
    while (!ended_) {
      std::this_thread::sleep_for(std::chrono::milliseconds(20));
      const double due = rate_ * std::chrono::duration<double>(Clock::now() - begin).count();
      v1::ImpulseBatch batch;
      if (sequence == 0) batch.set_client(random() | 1);
      while (static_cast<double>(sequence) < due && batch.impulse_size() < 1024) {
        v1::Impulse* push = batch.add_impulse();
        push->set_sequence(++sequence);
        push->set_body(ids[random() % ids.size()]);
        push->mutable_velocity_change()->set_x(speed(random));
        push->mutable_velocity_change()->set_z(speed(random));
      }
      if (batch.impulse_size() > 0 && !stream->Write(batch)) break;
    }
    stream->WritesDone();
    stream->Finish();
  }

  const double rate_;
  std::unique_ptr<v1::Simulation::Stub> stub_;
  v1::ImpulseSummary summary_;
  std::atomic<bool> ended_ = false;
  std::thread thread_;
};

template <class T>
double Quantile(std::vector<T>* values, double share) {
  if (values->empty()) return 0;
  const auto at = static_cast<std::ptrdiff_t>(share * static_cast<double>(values->size() - 1));
  std::nth_element(values->begin(), values->begin() + at, values->end());
  return static_cast<double>((*values)[static_cast<size_t>(at)]);
}

// The view of one client: everything, or a circle somewhere between the layout's borders.
v1::StreamReplicasRequest RequestOf(const LoadOptions& options, const v1::GetWorldResponse& world, int client) {
  v1::StreamReplicasRequest request;
  request.set_rate(options.rate);
  if (options.views == "all") return request;
  double min_x = -options.radius, max_x = options.radius, min_z = min_x, max_z = max_x;
  for (const v1::RegionRect& r : world.layout()) {
    for (double x : {r.min_x(), r.max_x()}) {
      if (std::isfinite(x)) min_x = std::min(min_x, x - options.radius), max_x = std::max(max_x, x + options.radius);
    }
    for (double z : {r.min_z(), r.max_z()}) {
      if (std::isfinite(z)) min_z = std::min(min_z, z - options.radius), max_z = std::max(max_z, z + options.radius);
    }
  }
  v1::Sphere* sphere = request.mutable_view()->mutable_sphere();
  sphere->mutable_centre()->set_x(min_x + (max_x - min_x) * std::fmod(0.754878 * client, 1));
  sphere->mutable_centre()->set_z(min_z + (max_z - min_z) * std::fmod(0.569840 * client, 1));
  sphere->set_radius(options.radius);
  return request;
}

Json Report(const LoadOptions& options, double seconds, const std::vector<std::unique_ptr<Watcher>>& watchers,
            const std::optional<v1::ImpulseSummary>& pushes) {
  std::vector<float> intervals;
  std::vector<int32_t> ticks;
  int64_t frames = 0, bytes = 0, failed = 0;
  int64_t least = std::numeric_limits<int64_t>::max();
  for (const auto& w : watchers) {
    frames += w->frames();
    bytes += w->bytes();
    failed += w->failed();
    least = std::min(least, w->frames());
    intervals.insert(intervals.end(), w->intervals_ms().begin(), w->intervals_ms().end());
    ticks.insert(ticks.end(), w->ticks().begin(), w->ticks().end());
  }
  const auto streams = static_cast<double>(watchers.size());
  const double usual = Quantile(&ticks, 0.5);
  const auto skipped = std::count_if(ticks.begin(), ticks.end(), [&](int32_t t) { return t > usual; });
  Json out = {
      {"clients", options.clients},
      {"streams", watchers.size()},
      {"seconds", seconds},
      {"frames_per_second", static_cast<double>(frames) / streams / seconds},
      {"least_frames_per_second", static_cast<double>(least) / seconds},
      {"skipping_frames", ticks.empty() ? 0 : static_cast<double>(skipped) / static_cast<double>(ticks.size())},
      {"kbit_per_second", static_cast<double>(bytes) * 8e-3 / streams / seconds},
      {"interval_ms",
       {{"p50", Quantile(&intervals, 0.5)}, {"p99", Quantile(&intervals, 0.99)}, {"max", Quantile(&intervals, 1)}}},
      {"failed_streams", failed}};
  if (pushes.has_value()) {
    int64_t rejected = 0;
    for (const v1::Rejected& r : pushes->rejected()) rejected += r.count();
    out["pushes"] = {{"applied", pushes->applied()}, {"rejected", rejected}};
  }
  return out;
}

}  // namespace

CLI::App* AddLoad(CLI::App& app, LoadOptions* o) {
  CLI::App* c = app.add_subcommand("load", "Many clients of a running world at once, and what they got");
  c->add_option("--server", o->server, "Any region server of the world, as aureole up prints them")
      ->required()
      ->type_name("HOST:PORT");
  AddAccess(c);
  c->add_option("--clients", o->clients, "Clients, each with connections of its own")
      ->capture_default_str()
      ->check(CLI::Range(1, 100000));
  c->add_option("--views", o->views, "What they see: the whole world, or each another part of it")
      ->capture_default_str()
      ->check(CLI::IsMember({"all", "distinct"}));
  c->add_option("--radius", o->radius, "Of a distinct view, m")->capture_default_str()->check(CLI::Range(1.0, 1e6));
  c->add_option("--rate", o->rate, "Frames per second")->capture_default_str()->check(CLI::Range(0.1, 1000.0));
  c->add_option("--push-rate", o->push_rate, "Pushes per second, of all clients together")
      ->capture_default_str()
      ->check(CLI::Range(0.0, 1e6));
  AddDuration(c, &o->duration_s, "How long they are measured, after a second to settle; 10s when not given");
  c->add_flag("--json", o->json, "One JSON object instead of text");
  c->footer(
      std::string(
          "Examples:\n"
          "  aureole load --server 127.0.0.1:40001 --clients 200\n"
          "  aureole load --server 127.0.0.1:40001 --clients 50 --views distinct --radius 40 --push-rate 500\n\n") +
      kExitCodesHelp);
  return c;
}

int RunLoad(const LoadOptions& options) {
  const auto stub = v1::Simulation::NewStub(Connect(options.server));
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(10));
  v1::GetWorldResponse world;
  if (const grpc::Status s = stub->GetWorld(&context, {}, &world); !s.ok()) {
    std::cerr << "--server " << options.server << ": " << s.error_message() << '\n';
    return kExitBadInput;
  }
  std::vector<std::unique_ptr<Watcher>> watchers;
  for (int i = 0; i < options.clients; ++i) {
    for (const std::string& endpoint : client::EndpointsOf(world)) {
      watchers.push_back(std::make_unique<Watcher>(endpoint, RequestOf(options, world, i)));
    }
  }
  std::unique_ptr<Pusher> pusher;
  if (options.push_rate > 0) pusher = std::make_unique<Pusher>(options.server, options.push_rate);
  const auto wait = [](double seconds) {
    const Clock::time_point end =
        Clock::now() + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(seconds));
    while (Interrupts() == 0 && Clock::now() < end) std::this_thread::sleep_for(std::chrono::milliseconds(20));
  };
  wait(1);
  for (auto& w : watchers) w->Reset();
  const Clock::time_point begin = Clock::now();
  wait(options.duration_s);
  const double seconds = std::chrono::duration<double>(Clock::now() - begin).count();
  std::optional<v1::ImpulseSummary> pushes;
  if (pusher != nullptr) pushes = pusher->End();
  for (auto& w : watchers) w->End();
  const Json report = Report(options, seconds, watchers, pushes);
  if (options.json) {
    std::cout << report.dump() << std::endl;
  } else {
    std::cout << absl::StrFormat(
        "%d clients, %d streams, %.1f s: %.1f frames/s each (least %.1f), %.0f kbit/s each, %.2f %% of the frames "
        "after "
        "a gap\nbetween frames: p50 %.1f, p99 %.1f, max %.1f ms\n",
        options.clients, watchers.size(), seconds, report["frames_per_second"].get<double>(),
        report["least_frames_per_second"].get<double>(), report["kbit_per_second"].get<double>(),
        100 * report["skipping_frames"].get<double>(), report["interval_ms"]["p50"].get<double>(),
        report["interval_ms"]["p99"].get<double>(), report["interval_ms"]["max"].get<double>());
    if (pushes.has_value()) {
      std::cout << "pushes: " << report["pushes"]["applied"] << " applied, " << report["pushes"]["rejected"]
                << " rejected\n";
    }
  }
  for (const auto& w : watchers) {
    if (!w->failed()) continue;
    std::cerr << "aureole: a stream ended: " << w->status().error_message() << '\n';
    return kExitFailed;
  }
  return Interrupts() > 0 ? kExitInterrupted : kExitOk;
}

}  // namespace aureole
