#include "client/cli/operate.h"

#include <chrono>
#include <iostream>
#include <memory>
#include <thread>

#include <absl/strings/str_format.h>
#include <absl/time/time.h>
#include <google/protobuf/util/json_util.h>
#include <grpcpp/grpcpp.h>

#include "aureole/v1/control_plane.grpc.pb.h"
#include "client/cli/connect.h"
#include "client/cli/exit_codes.h"
#include "client/src/channel.h"
#include "server/control/interrupts.h"

namespace aureole {
namespace {

constexpr std::chrono::seconds kPatience{10};
constexpr std::chrono::milliseconds kLookEvery{200};

using Stub = v1::ControlPlane::StubInterface;

std::unique_ptr<Stub> Reach(const OperateOptions& o) {
  return v1::ControlPlane::NewStub(client::ChannelTo(o.control, GivenAccess()));
}

// kExitOk, or what went wrong after a message on stderr.
int Say(const grpc::Status& s) {
  if (s.ok()) return kExitOk;
  std::cerr << s.error_message() << '\n';
  const bool wrong = s.error_code() == grpc::StatusCode::INVALID_ARGUMENT ||
                     s.error_code() == grpc::StatusCode::FAILED_PRECONDITION ||
                     s.error_code() == grpc::StatusCode::NOT_FOUND;
  return wrong ? kExitBadInput : kExitFailed;
}

// Which of a control plane's worlds the call is about.
void NameWorld(const OperateOptions& o, grpc::ClientContext* context) {
  if (!o.world.empty()) context->AddMetadata("aureole-world", o.world);
}

template <class Request, class Response>
int Call(const OperateOptions& o, Stub* stub,
         grpc::Status (Stub::*method)(grpc::ClientContext*, const Request&, Response*), const Request& request,
         Response* response, std::chrono::milliseconds at_most = kPatience) {
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + at_most);
  NameWorld(o, &context);
  return Say((stub->*method)(&context, request, response));
}

// On a line of its own.
void PrintJson(const google::protobuf::Message& message) {
  std::string text;
  google::protobuf::util::JsonPrintOptions options;
  options.always_print_primitive_fields = true;
  options.preserve_proto_field_names = true;
  if (google::protobuf::util::MessageToJsonString(message, &text, options).ok()) std::cout << text << std::endl;
}

void Print(const v1::ControlEvent& event, bool json) {
  if (json) return PrintJson(event);
  if (event.missed() > 0) std::cout << event.missed() << " events before are not kept any more\n";
  std::cout << absl::FormatTime("%Y-%m-%dT%H:%M:%E3SZ", absl::FromUnixMicros(event.unix_us()), absl::UTCTimeZone())
            << (event.warning() ? " warning " : " ") << v1::ControlEvent::Kind_Name(event.kind()) << " ";
  if (event.has_region()) std::cout << "region " << event.region() << ": ";
  std::cout << event.text() << std::endl;
}

void Print(const v1::ControlledWorld& world, bool json) {
  if (json) return PrintJson(world);
  std::cout << "world " << world.name() << ", layout epoch " << world.layout_epoch()
            << (world.changing() ? ", changing" : "") << '\n';
  if (!world.refused().empty()) std::cout << "refused: " << world.refused() << '\n';
  std::cout << absl::StrFormat("%6s %-8s %9s %9s %9s %9s %9s %9s  %s\n", "region", "", "min x", "max x", "min z",
                               "max z", "bodies", "tick", "server");
  for (int i = 0; i < world.regions_size(); ++i) {
    const v1::ControlledRegion& r = world.regions(i);
    const bool left = !r.member() && r.endpoint().empty();
    std::cout << absl::StrFormat("%6d %-8s %9.4g %9.4g %9.4g %9.4g %9d %9d  %s\n", i,
                                 left         ? "left"
                                 : r.member() ? "member"
                                              : "-",
                                 r.min_x(), r.max_x(), r.min_z(), r.max_z(), r.bodies(), r.tick(), r.endpoint());
  }
  std::cout.flush();
}

// Until the layout is the wanted one, or the time is over.
int Await(Stub* stub, const OperateOptions& o) {
  const auto until = std::chrono::steady_clock::now() + std::chrono::duration<double>(o.wait_s);
  for (;;) {
    v1::ControlledWorld world;
    if (const int code = Call(o, stub, &Stub::GetWorld, v1::GetControlledWorldRequest(), &world); code != kExitOk) {
      return code;
    }
    const bool over = std::chrono::steady_clock::now() >= until;
    if (!world.changing() || over) {
      Print(world, o.json);
      if (world.changing() && o.wait_s > 0) std::cerr << "not done after " << o.wait_s << " s; it goes on\n";
      return world.changing() && o.wait_s > 0 ? kExitFailed : kExitOk;
    }
    std::this_thread::sleep_for(kLookEvery);
  }
}

void AddControl(CLI::App* c, OperateOptions* o) {
  c->add_option("--control", o->control,
                "The world's control plane: --listen of aureole-control, --control of aureole up")
      ->required()
      ->type_name("HOST:PORT");
  c->add_option("--world", o->world, "Which of its worlds, where it has several: the name of the World on Kubernetes");
  c->add_flag("--json", o->json, "One JSON object");
  AddAccess(c);
}

void AddWait(CLI::App* c, OperateOptions* o) {
  c->add_option("--wait", o->wait_s, "Seconds to wait until it is done; 0: not at all")
      ->check(CLI::Range(0.0, 86400.0))
      ->capture_default_str();
}

}  // namespace

CLI::App* AddWorld(CLI::App& app, OperateOptions* o) {
  CLI::App* c = app.add_subcommand("world", "How a running world is divided, and how its servers do");
  AddControl(c, o);
  c->footer(std::string("Example:\n  aureole world --control 127.0.0.1:40000\n\n") + kExitCodesHelp);
  return c;
}

CLI::App* AddEvents(CLI::App& app, OperateOptions* o) {
  CLI::App* c = app.add_subcommand("events", "What has happened to a running world and its servers");
  AddControl(c, o);
  c->add_flag("--follow", o->follow, "Go on with what happens, over control planes that come and go");
  c->add_option("--after", o->after, "Only events after the one with this sequence (--json tells it)");
  c->footer(std::string("Example:\n  aureole events --control 127.0.0.1:40000 --follow\n\n") + kExitCodesHelp);
  return c;
}

CLI::App* AddResize(CLI::App& app, OperateOptions* o) {
  CLI::App* c = app.add_subcommand("resize", "Divide a running world between more servers, or fewer");
  AddControl(c, o);
  c->add_option("--columns", o->columns, "Regions along x")->required()->check(CLI::Range(1, 64));
  c->add_option("--rows", o->rows, "Regions along z")->check(CLI::Range(1, 64))->capture_default_str();
  AddWait(c, o);
  c->footer(std::string("Example:\n  aureole resize --control 127.0.0.1:40000 --columns 3 --rows 2\n\n") +
            kExitCodesHelp);
  return c;
}

CLI::App* AddDrain(CLI::App& app, OperateOptions* o) {
  CLI::App* c = app.add_subcommand("drain", "Empty a region of a running world; its server then ends");
  AddControl(c, o);
  c->add_option("region", o->region, "Its number")->required()->check(CLI::NonNegativeNumber);
  AddWait(c, o);
  c->footer(std::string("Example:\n  aureole drain 3 --control 127.0.0.1:40000\n\n") + kExitCodesHelp);
  return c;
}

CLI::App* AddCheckpoint(CLI::App& app, OperateOptions* o) {
  CLI::App* c = app.add_subcommand("checkpoint", "Have all servers of a running world make a checkpoint now");
  AddControl(c, o);
  c->add_flag("--copied", o->copied, "Wait until the copies at the neighbours are durable, too");
  c->add_option("--wait", o->wait_s, "Seconds to wait at most")->check(CLI::Range(1.0, 86400.0))->capture_default_str();
  c->footer(std::string("Example:\n  aureole checkpoint --control 127.0.0.1:40000\n\n") + kExitCodesHelp);
  return c;
}

int RunWorldCommand(const OperateOptions& o) {
  v1::ControlledWorld world;
  const int code = Call(o, Reach(o).get(), &Stub::GetWorld, v1::GetControlledWorldRequest(), &world);
  if (code == kExitOk) Print(world, o.json);
  return code;
}

int RunEvents(const OperateOptions& o) {
  const std::unique_ptr<Stub> stub = Reach(o);
  v1::WatchEventsRequest request;
  request.set_after_sequence(o.after);
  request.set_follow(o.follow);
  using Clock = std::chrono::steady_clock;
  auto lost = Clock::now();  // since when there is no control plane
  for (;;) {
    const auto begun = Clock::now();
    bool heard = false;
    grpc::ClientContext context;
    NameWorld(o, &context);
    if (!o.follow) context.set_deadline(std::chrono::system_clock::now() + kPatience);
    const std::jthread interrupted([&context](const std::stop_token& stop) {
      while (!stop.stop_requested() && Interrupts() == 0) std::this_thread::sleep_for(kLookEvery);
      if (!stop.stop_requested()) context.TryCancel();
    });
    const auto stream = stub->WatchEvents(&context, request);
    v1::ControlEvent event;
    while (stream->Read(&event)) {
      Print(event, o.json);
      request.set_after_sequence(event.sequence());
      heard = true;
    }
    const grpc::Status s = stream->Finish();
    if (Interrupts() > 0) return o.follow ? kExitOk : kExitInterrupted;
    if (!o.follow || s.error_code() != grpc::StatusCode::UNAVAILABLE) return Say(s);
    if (heard || Clock::now() - begun > kPatience) lost = Clock::now();
    if (Clock::now() - lost > kPatience) return Say(s);
    std::this_thread::sleep_for(kLookEvery);
  }
}

int RunResize(const OperateOptions& o) {
  const std::unique_ptr<Stub> stub = Reach(o);
  v1::ResizeLayoutRequest request;
  request.set_columns(o.columns);
  request.set_rows(o.rows);
  v1::ResizeLayoutResponse response;
  const int code = Call(o, stub.get(), &Stub::ResizeLayout, request, &response);
  return code == kExitOk ? Await(stub.get(), o) : code;
}

int RunDrain(const OperateOptions& o) {
  const std::unique_ptr<Stub> stub = Reach(o);
  v1::DrainRegionRequest request;
  request.set_region(o.region);
  v1::DrainRegionResponse response;
  const int code = Call(o, stub.get(), &Stub::DrainRegion, request, &response);
  return code == kExitOk ? Await(stub.get(), o) : code;
}

int RunCheckpoint(const OperateOptions& o) {
  v1::SaveCheckpointRequest request;
  request.set_copied(o.copied);
  v1::SaveCheckpointResponse saved;
  const int code = Call(o, Reach(o).get(), &Stub::SaveCheckpoint, request, &saved,
                        std::chrono::milliseconds(static_cast<int64_t>(1e3 * o.wait_s)));
  if (code != kExitOk) return code;
  if (o.json) {
    PrintJson(saved);
    return kExitOk;
  }
  std::cout << "every region has a durable checkpoint of tick " << saved.tick() << " or later\n";
  for (const v1::SavedRegion& r : saved.regions()) {
    std::cout << absl::StrFormat("region %d: tick %d, copy of tick %d\n", r.region(), r.tick(), r.copied_tick());
  }
  std::cout.flush();
  return kExitOk;
}

}  // namespace aureole
