#include "client/cli/watch.h"

#include <algorithm>
#include <chrono>
#include <iostream>
#include <thread>

#include <absl/strings/str_format.h>
#include <nlohmann/json.hpp>

#include "client/cli/connect.h"
#include "client/cli/exit_codes.h"
#include "client/cli/flags.h"
#include "server/control/interrupts.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;
using Json = nlohmann::ordered_json;

constexpr double kCompleteTimeout = 10;  // s

void PrintBodies(const client::Client& client, bool json) {
  std::vector<client::Body> bodies;
  int64_t tick = 0;
  client.Latest(&bodies, &tick);
  if (!json)
    std::cout << absl::StrFormat("%20s %6s %10s %10s %10s %8s  %s\n", "body", "region", "x", "y", "z", "speed", "");
  Json list = Json::array();
  for (const client::Body& b : bodies) {
    const client::Vec3 &p = b.position, &v = b.velocity;
    if (json) {
      const client::Quaternion& q = b.orientation;
      list.push_back({{"body", b.id},
                      {"region", b.region},
                      {"position", {p.x, p.y, p.z}},
                      {"orientation", {q.x, q.y, q.z, q.w}},
                      {"velocity", {v.x, v.y, v.z}},
                      {"asleep", b.asleep}});
    } else {
      std::cout << absl::StrFormat("%20d %6d %10.3f %10.3f %10.3f %8.2f  %s\n", b.id, b.region, p.x, p.y, p.z,
                                   std::hypot(v.x, v.y, v.z), b.asleep ? "asleep" : "");
    }
  }
  if (json) std::cout << Json{{"tick", tick}, {"bodies", list}}.dump() << '\n';
  std::cout.flush();
}

void PrintLine(const client::Client& client, const client::Counts& since, double seconds, bool json) {
  std::vector<client::Body> bodies;
  int64_t tick = 0;
  client.Latest(&bodies, &tick);
  const auto asleep = std::count_if(bodies.begin(), bodies.end(), [](const client::Body& b) { return b.asleep; });
  const client::Counts now = client.counts();
  const double frames = static_cast<double>(now.frames - since.frames) / seconds;
  const double kbit = static_cast<double>(now.bytes - since.bytes) * 8e-3 / seconds;
  if (json) {
    std::cout << Json{{"tick", tick},
                      {"bodies", bodies.size()},
                      {"asleep", asleep},
                      {"real_time_factor", client.real_time_factor()},
                      {"frames_per_second", frames},
                      {"kbit_per_second", kbit},
                      {"lost_connections", now.lost_connections}}
                     .dump()
              << std::endl;
  } else {
    std::cout << absl::StrFormat("tick %d (%.1f s), speed %.2f, bodies %d (%d asleep), %.0f frames/s, %.0f kbit/s",
                                 tick, static_cast<double>(tick) * client.world().tick_seconds,
                                 client.real_time_factor(), bodies.size(), asleep, frames, kbit);
    if (now.lost_connections > 0) std::cout << ", " << now.lost_connections << " connections lost";
    std::cout << std::endl;
  }
}

}  // namespace

CLI::App* AddWatch(CLI::App& app, WatchCliOptions* o) {
  CLI::App* c = app.add_subcommand("watch", "What is in view of a running world");
  AddServer(c, &o->server);
  CLI::Option* rect = c->add_option("--rect", o->rect, "Part in view; everything when not given")
                          ->delimiter(',')
                          ->expected(4)
                          ->type_name("MIN_X,MAX_X,MIN_Z,MAX_Z");
  c->add_option("--sphere", o->sphere, "Likewise")
      ->delimiter(',')
      ->expected(3)
      ->type_name("X,Z,RADIUS")
      ->excludes(rect);
  c->add_option("--rate", o->rate, "Frames per second")->capture_default_str()->check(CLI::Range(0.1, 1000.0));
  AddDuration(c, &o->duration_s, "Until interrupted when not given");
  c->add_flag("--bodies", o->bodies, "Print every body in view, once, and end");
  c->add_flag("--json", o->json, "JSON, one object per line");
  c->footer(std::string("Examples:\n"
                        "  aureole watch --server 127.0.0.1:40001\n"
                        "  aureole watch --server 127.0.0.1:40001 --rect -10,10,-10,10 --bodies --json\n\n") +
            kExitCodesHelp);
  return c;
}

int RunWatch(const WatchCliOptions& o) {
  const std::unique_ptr<client::Client> client = ConnectTo(o.server);
  if (client == nullptr) return kExitBadInput;
  client::WatchOptions watch;
  watch.rate = o.rate;
  if (!o.rect.empty()) watch.rect = client::Rect{o.rect[0], o.rect[1], o.rect[2], o.rect[3]};
  if (!o.sphere.empty()) watch.sphere = client::Sphere{{o.sphere[0], 0, o.sphere[1]}, o.sphere[2]};
  if (const client::Status s = client->Watch(watch); !s.ok()) return Report(s);
  if (!client->WaitUntilComplete(kCompleteTimeout)) {
    std::cerr << "aureole: not every region server tells what it has; see aureole up\n";
    return kExitFailed;
  }
  if (o.bodies) {
    PrintBodies(*client, o.json);
    return kExitOk;
  }
  const Clock::time_point begin = Clock::now();
  Clock::time_point last = begin;
  client::Counts counts = client->counts();
  while (Interrupts() == 0) {
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
    const Clock::time_point now = Clock::now();
    const bool done = o.duration_s > 0 && std::chrono::duration<double>(now - begin).count() >= o.duration_s;
    const double seconds = std::chrono::duration<double>(now - last).count();
    if (!done && seconds < 1) continue;
    PrintLine(*client, counts, seconds, o.json);
    if (done) return kExitOk;
    counts = client->counts();
    last = now;
  }
  return o.duration_s > 0 ? kExitInterrupted : kExitOk;
}

}  // namespace aureole
