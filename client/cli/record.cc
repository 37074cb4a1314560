#include "client/cli/record.h"

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <functional>
#include <iostream>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#include <absl/strings/str_format.h>
#include <grpcpp/grpcpp.h>
#include <nlohmann/json.hpp>

#include "aureole/v1/recording.grpc.pb.h"
#include "aureole/v1/simulation.grpc.pb.h"
#include "client/cli/connect.h"
#include "client/cli/exit_codes.h"
#include "client/cli/flags.h"
#include "client/cli/mcap_writer.h"
#include "client/cli/recording.h"
#include "client/src/channel.h"
#include "server/control/interrupts.h"
#include "server/replay/replay.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;
using Json = nlohmann::ordered_json;

constexpr int kTries = 6;  // to name a tick that is to come everywhere

std::shared_ptr<grpc::Channel> Connect(const std::string& endpoint) {
  grpc::ChannelArguments arguments;
  arguments.SetMaxReceiveMessageSize(-1);
  return client::ChannelTo(endpoint, GivenAccess(), std::move(arguments));
}

grpc::Status AskWorld(const std::shared_ptr<grpc::Channel>& channel, bool scene, v1::GetWorldResponse* world) {
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(10));
  v1::GetWorldRequest request;
  request.set_scene(scene);
  return v1::Simulation::NewStub(channel)->GetWorld(&context, request, world);
}

// All streams into one file.
class Recorder {
 public:
  Recorder(const RecordOptions& options, std::unique_ptr<McapWriter> file, v1::GetWorldResponse world)
      : options_(options), file_(std::move(file)), world_(std::move(world)) {
    for (int r = 0; r < world_.endpoints_size(); ++r) {
      if (world_.endpoints(r).empty()) continue;
      channels_[r] = Connect(world_.endpoints(r));
      hashed_[r] = 0;
    }
  }
  ~Recorder() { Stop(); }

  // Begins at a tick that is to come in all regions. A status that is not OK: nothing is being recorded.
  grpc::Status Start() {
    Write(kWorldTopic, world_, world_.tick());
    for (int lead = std::max(8, static_cast<int>(500'000 / world_.tick_us())), n = 0;; lead *= 4, ++n) {
      int64_t tick = 0;
      for (const auto& [region, channel] : channels_) {
        v1::GetWorldResponse now;
        if (const grpc::Status s = AskWorld(channel, false, &now); !s.ok()) return s;
        if (now.layout_epoch() > world_.layout_epoch()) {
          return {grpc::StatusCode::ABORTED, "the layout of the world has just changed; record again"};
        }
        tick = std::max(tick, now.tick());
      }
      const grpc::Status s = StartAt(tick + lead);
      if (s.error_code() != grpc::StatusCode::OUT_OF_RANGE || n == kTries) return s;
    }
  }

  // Ends all streams. Start, too, returns then.
  void Cancel() {
    const std::lock_guard lock(mutex_);
    stopping_ = true;
    for (grpc::ClientContext* c : contexts_) c->TryCancel();
  }
  // And waits for their threads.
  void Stop() {
    Cancel();
    for (std::thread& t : threads_) t.join();
    threads_.clear();
  }
  absl::Status Close() {
    const std::lock_guard lock(mutex_);
    return written_.ok() ? file_->Close() : written_;
  }

  void Flush() {
    const std::lock_guard lock(mutex_);
    if (written_.ok()) written_ = file_->Flush();
  }

  // Why it cannot go on; empty while it can.
  std::string failure() {
    const std::lock_guard lock(mutex_);
    return written_.ok() ? failure_ : std::string(written_.message());
  }
  // Simulated time for which all regions have told what they had to, s.
  double seconds() {
    const std::lock_guard lock(mutex_);
    int64_t tick = std::numeric_limits<int64_t>::max();
    for (const auto& [region, told] : hashed_) tick = std::min(tick, told);
    return tick <= from_ ? 0 : static_cast<double>((tick - from_) * world_.tick_us()) * 1e-6;
  }
  int64_t inputs() const { return inputs_; }
  int64_t bytes() {
    const std::lock_guard lock(mutex_);
    return file_->bytes();
  }
  int64_t from() const { return from_; }

 private:
  template <class Message>
  void Write(const std::string& topic, const Message& message, int64_t tick) {
    const std::string bytes = message.SerializeAsString();
    const std::lock_guard lock(mutex_);
    if (!written_.ok()) return;
    written_ = file_->Write(topic, Message::descriptor(), static_cast<uint64_t>(tick * world_.tick_us()) * 1000, bytes);
  }

  void Fail(const std::string& what) {
    const std::lock_guard lock(mutex_);
    if (!stopping_ && failure_.empty()) failure_ = what;
  }

  template <class Message>
  void Read(const std::shared_ptr<grpc::ClientContext>& context, grpc::ClientReader<Message>* stream,
            const std::string& what, const std::function<void(const Message&)>& take) {
    Message message;
    while (stream->Read(&message)) take(message);
    const grpc::Status s = stream->Finish();
    if (!stopping_) Fail(what + " ended: " + s.error_message());
    const std::lock_guard lock(mutex_);
    std::erase(contexts_, context.get());
  }

  std::shared_ptr<grpc::ClientContext> NewContext() {
    auto out = std::make_shared<grpc::ClientContext>();
    const std::lock_guard lock(mutex_);
    contexts_.push_back(out.get());
    if (stopping_) out->TryCancel();
    return out;
  }

  grpc::Status StartAt(int64_t tick) {
    struct Opened {
      int region = -1;
      std::shared_ptr<grpc::ClientContext> context;
      std::unique_ptr<grpc::ClientReader<v1::Recorded>> stream;
      v1::Recorded first;
    };
    std::vector<Opened> opened;
    grpc::Status refusal;
    for (const auto& [region, channel] : channels_) {
      v1::RecordRequest request;
      request.set_from_tick(tick);
      request.set_hash_every(options_.hash_every);
      request.set_inputs(opened.empty());
      Opened& o = opened.emplace_back();
      o.region = region;
      o.context = NewContext();
      o.stream = v1::Recording::NewStub(channel)->Record(o.context.get(), request);
    }
    for (Opened& o : opened) {
      if (!refusal.ok()) o.context->TryCancel();
      if (o.stream->Read(&o.first)) continue;
      const grpc::Status s = o.stream->Finish();
      if (refusal.ok()) refusal = s.ok() ? grpc::Status(grpc::StatusCode::UNAVAILABLE, "the stream ended") : s;
      const std::lock_guard lock(mutex_);
      std::erase(contexts_, o.context.get());
      o.stream = nullptr;
    }
    if (!refusal.ok()) {
      for (Opened& o : opened) {
        if (o.stream == nullptr) continue;
        o.context->TryCancel();
        o.stream->Finish();
        const std::lock_guard lock(mutex_);
        std::erase(contexts_, o.context.get());
      }
      return refusal;
    }
    from_ = tick;
    for (Opened& each : opened) {
      const int region = each.region;
      threads_.emplace_back([this, region, o = std::make_shared<Opened>(std::move(each))] {
        std::string snapshot;
        TakeRecorded(region, o->first, &snapshot);
        Read<v1::Recorded>(o->context, o->stream.get(), absl::StrCat("the recording of region ", region),
                           [&](const v1::Recorded& m) { TakeRecorded(region, m, &snapshot); });
      });
      threads_.emplace_back([this, region] { ReadStatus(region); });
      if (options_.rate > 0) threads_.emplace_back([this, region] { ReadFrames(region); });
    }
    return grpc::Status::OK;
  }

  void TakeRecorded(int region, const v1::Recorded& message, std::string* snapshot) {
    snapshot->append(message.snapshot_part());
    if (message.snapshot_complete()) {
      v1::Snapshot whole;
      if (!whole.ParseFromString(*snapshot)) return Fail(absl::StrCat("region ", region, " told no snapshot"));
      *snapshot = {};
      Write(RegionTopic(region, "snapshot"), whole, whole.tick());
      Flush();
    }
    google::protobuf::RepeatedPtrField<v1::Input> inputs = message.inputs();
    ExpandShapes(&inputs);
    for (const v1::Input& i : inputs) {
      Write(kInputsTopic, i, i.tick());
      ++inputs_;
    }
    if (!message.has_hashes()) return;
    // What follows is the state on servers of which this recording has no snapshot.
    if (message.hashes().layout_epoch() > world_.layout_epoch()) {
      return Fail(absl::StrCat("the layout of the world has changed by tick ", message.hashes().tick(),
                               "; what was recorded until then is whole; record again to go on"));
    }
    Write(RegionTopic(region, "hashes"), message.hashes(), message.hashes().tick());
    const std::lock_guard lock(mutex_);
    hashed_.at(region) = message.hashes().tick();
  }

  void ReadStatus(int region) {
    const auto context = NewContext();
    const auto stream = v1::Simulation::NewStub(channels_.at(region))->WatchLayout(context.get(), {});
    Read<v1::LayoutUpdate>(context, stream.get(), absl::StrCat("the status of region ", region),
                           [&](const v1::LayoutUpdate& m) {
                             if (m.has_status()) Write(RegionTopic(region, "status"), m.status(), m.status().tick());
                           });
  }

  void ReadFrames(int region) {
    const auto context = NewContext();
    v1::StreamReplicasRequest request;
    request.set_rate(options_.rate);
    request.set_velocities(true);
    const auto stream = v1::Simulation::NewStub(channels_.at(region))->StreamReplicas(context.get(), request);
    Read<v1::ReplicaFrame>(context, stream.get(), absl::StrCat("the frames of region ", region),
                           [&](const v1::ReplicaFrame& m) { Write(RegionTopic(region, "frames"), m, m.tick()); });
  }

  const RecordOptions options_;
  const std::unique_ptr<McapWriter> file_;
  const v1::GetWorldResponse world_;
  std::map<int, std::shared_ptr<grpc::Channel>> channels_;  // by region; those that have left have none
  int64_t from_ = 0;
  std::atomic<bool> stopping_ = false;
  std::atomic<int64_t> inputs_ = 0;

  std::mutex mutex_;
  std::vector<grpc::ClientContext*> contexts_;
  absl::Status written_;
  std::string failure_;
  std::map<int, int64_t> hashed_;  // last tick, by region

  std::vector<std::thread> threads_;
};

}  // namespace

CLI::App* AddRecord(CLI::App& app, RecordOptions* o) {
  CLI::App* c = app.add_subcommand("record", "Record a running world: its state, its inputs, and what clients see");
  AddServer(c, &o->server);
  c->add_option("--out,-o", o->out, "The file (MCAP); replaced when it is there")->required()->type_name("FILE");
  AddDuration(c, &o->duration_s, "Of simulated time; until interrupted when not given");
  c->add_option("--hash-every", o->hash_every,
                "Ticks between the hashes that aureole replay --verify compares; the smaller, the closer it finds a "
                "difference")
      ->capture_default_str()
      ->check(CLI::Range(1, 100000));
  c->add_option("--rate", o->rate, "Frames per second for the viewer and the report; 0: none")
      ->capture_default_str()
      ->check(CLI::Range(0.0, 1000.0));
  c->add_flag("--json", o->json, "What was recorded as JSON");
  c->footer(
      std::string("Examples:\n"
                  "  aureole record --server 127.0.0.1:40001 --out run.mcap --duration 10s\n"
                  "  aureole replay run.mcap --verify\n"
                  "  aureole report run.mcap --out run.svg\n\n"
                  "Foxglove and @mcap/core open the file. Worlds whose exchange has a delay cannot be recorded.\n") +
      kExitCodesHelp);
  return c;
}

int RunRecord(const RecordOptions& o) {
  v1::GetWorldResponse world;
  if (const grpc::Status s = AskWorld(Connect(o.server), true, &world); !s.ok()) {
    std::cerr << "--server " << o.server << ": no region server answers there (" << s.error_message() << ")\n";
    return kExitBadInput;
  }
  absl::StatusOr<std::unique_ptr<McapWriter>> file = McapWriter::Open(o.out);
  if (!file.ok()) {
    std::cerr << "--out " << std::string(file.status().message()) << '\n';
    return kExitBadInput;
  }
  Recorder recorder(o, *std::move(file), std::move(world));
  // A world that stands still never comes to the tick at which it would begin.
  std::atomic<bool> started = false;
  std::thread interrupter([&] {
    while (!started && Interrupts() == 0) std::this_thread::sleep_for(std::chrono::milliseconds(20));
    if (!started) recorder.Cancel();
  });
  const grpc::Status begun = recorder.Start();
  started = true;
  interrupter.join();
  if (Interrupts() > 0) return kExitInterrupted;
  if (const grpc::Status& s = begun; !s.ok()) {
    std::cerr << "aureole: cannot record: " << s.error_message() << '\n';
    return kExitFailed;
  }
  const bool terminal = isatty(STDERR_FILENO) != 0;
  Clock::time_point told = Clock::now(), flushed = told;
  const auto progress = [&](const char* end) {
    const double seconds = recorder.seconds();
    std::cerr << (terminal ? "\r\033[K" : "");
    if (o.duration_s > 0) {
      std::cerr << absl::StrFormat("recorded %.1f of %.1f s, %.1f MB%s", seconds, o.duration_s,
                                   static_cast<double>(recorder.bytes()) * 1e-6, end);
    } else {
      std::cerr << absl::StrFormat("recorded %.1f s, %.1f MB%s", seconds, static_cast<double>(recorder.bytes()) * 1e-6,
                                   end);
    }
    std::cerr.flush();
  };
  bool done = false;
  while (!done && Interrupts() == 0 && recorder.failure().empty()) {
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
    done = o.duration_s > 0 && recorder.seconds() >= o.duration_s;
    if (Clock::now() - flushed > std::chrono::seconds(1)) {
      flushed = Clock::now();
      recorder.Flush();
    }
    if (Clock::now() - told < (terminal ? std::chrono::milliseconds(200) : std::chrono::milliseconds(5000))) continue;
    told = Clock::now();
    progress(terminal ? "" : "\n");
  }
  const std::string failure = recorder.failure();
  recorder.Stop();
  if (terminal) progress("\n");
  if (const absl::Status s = recorder.Close(); !s.ok()) {
    std::cerr << "aureole: " << std::string(s.message()) << '\n';
    return kExitFailed;
  }
  if (o.json) {
    std::cout << Json{{"file", o.out},
                      {"from_tick", recorder.from()},
                      {"seconds", recorder.seconds()},
                      {"inputs", recorder.inputs()},
                      {"bytes", recorder.bytes()}}
                     .dump()
              << '\n';
  } else {
    std::cout << absl::StrFormat("%s: %.1f s from tick %d on, %d inputs, %.1f MB\n", o.out, recorder.seconds(),
                                 recorder.from(), recorder.inputs(), static_cast<double>(recorder.bytes()) * 1e-6);
  }
  if (!failure.empty()) {
    std::cerr << "aureole: the recording ends early: " << failure << '\n';
    return kExitFailed;
  }
  return done || o.duration_s == 0 ? kExitOk : kExitInterrupted;
}

}  // namespace aureole
