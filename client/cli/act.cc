#include "client/cli/act.h"

#include <iostream>

#include <absl/strings/numbers.h>
#include <absl/strings/str_format.h>
#include <absl/strings/str_split.h>
#include <nlohmann/json.hpp>

#include "client/cli/connect.h"
#include "client/cli/exit_codes.h"

namespace aureole {
namespace {

using Json = nlohmann::ordered_json;

constexpr double kTimeout = 10;  // s

// "sphere:0.5", "box:1,2,1", "capsule:0.3,1", "cylinder:0.3,1"; false when it is none.
bool ReadShape(const std::string& text, client::Shape* out) {
  const std::pair<std::string, std::string> parts = absl::StrSplit(text, absl::MaxSplits(':', 1));
  std::vector<double> sizes;
  for (absl::string_view s : absl::StrSplit(parts.second, ',')) {
    if (!absl::SimpleAtod(s, &sizes.emplace_back())) return false;
  }
  const auto is = [&](const char* name, size_t n) { return parts.first == name && sizes.size() == n; };
  if (is("sphere", 1)) {
    out->radius = sizes[0];
  } else if (is("box", 3)) {
    out->kind = client::Shape::Kind::kBox;
    out->size = {sizes[0], sizes[1], sizes[2]};
  } else if (is("capsule", 2) || is("cylinder", 2)) {
    out->kind = parts.first == "capsule" ? client::Shape::Kind::kCapsule : client::Shape::Kind::kCylinder;
    out->radius = sizes[0];
    out->height = sizes[1];
  } else {
    return false;
  }
  return true;
}

}  // namespace

CLI::App* AddPush(CLI::App& app, PushOptions* o) {
  CLI::App* c = app.add_subcommand("push", "Push bodies of a running world");
  AddServer(c, &o->server);
  CLI::Option* body = c->add_option("--body", o->body, "The body's id");
  CLI::Option* sphere = c->add_option("--sphere", o->sphere, "Instead: every body in a sphere")
                            ->delimiter(',')
                            ->expected(4)
                            ->type_name("X,Y,Z,RADIUS")
                            ->excludes(body);
  c->add_option("--outward", o->outward, "With a sphere: so much away from its centre, N s or the unit of the push")
      ->needs(sphere);
  c->add_flag("--fades", o->fades, "--outward falls off to nothing at the radius")->needs(sphere);
  CLI::Option* impulse = AddVector(c, "--impulse", &o->impulse, "Impulse, N s");
  CLI::Option* velocity = AddVector(c, "--velocity", &o->velocity, "Change of velocity, m/s")->excludes(impulse);
  CLI::Option* force = AddVector(c, "--force", &o->force, "Force, N")->excludes(impulse)->excludes(velocity);
  c->add_option("--for", o->seconds, "How long a force acts, s")->needs(force);
  AddVector(c, "--spin", &o->spin, "The angular part: N m s, rad/s or N m");
  AddVector(c, "--at", &o->point, "Where an impulse or a force acts, m; at the centre of mass when not given");
  c->add_option("--times", o->times, "So often")->capture_default_str()->check(CLI::Range(1, 1000000));
  c->add_flag("--json", o->json, "One JSON object instead of text");
  c->footer(
      std::string("Examples:\n"
                  "  aureole push --server 127.0.0.1:40001 --body 7 --velocity 0,5,0\n"
                  "  aureole push --server 127.0.0.1:40001 --sphere 0,1,0,10 --outward 50 --fades\n"
                  "  aureole push --server 127.0.0.1:40001 --body 7 --force 0,0,100 --for 0.5\n\n"
                  "Exit codes: 0 it acted; 1 it did not; 2 bad input."));
  return c;
}

int RunPush(const PushOptions& o) {
  if (o.impulse.empty() && o.velocity.empty() && o.force.empty() && o.spin.empty() && o.outward == 0) {
    std::cerr << "--impulse: give one, or --velocity, --force, --spin, or --outward with --sphere\n";
    return kExitBadInput;
  }
  client::Push push;
  push.body = o.body;
  if (!o.sphere.empty()) push.sphere = client::Sphere{{o.sphere[0], o.sphere[1], o.sphere[2]}, o.sphere[3]};
  push.outward = o.outward;
  push.fades = o.fades;
  push.angular = VectorOf(o.spin);
  push.linear = VectorOf(o.impulse);
  if (!o.velocity.empty()) {
    push.kind = client::Push::Kind::kVelocityChange;
    push.linear = VectorOf(o.velocity);
  } else if (!o.force.empty()) {
    push.kind = client::Push::Kind::kForce;
    push.linear = VectorOf(o.force);
    push.seconds = o.seconds;
  }
  if (!o.point.empty()) push.point = VectorOf(o.point);
  const std::unique_ptr<client::Client> client = ConnectTo(o.server);
  if (client == nullptr) return kExitBadInput;
  for (int i = 0; i < o.times; ++i) client->Do(push);
  client::PushCounts counts;
  if (const client::Status s = client->Flush(kTimeout + o.times * 1e-3, &counts); !s.ok()) return Report(s);
  Json rejected = Json::object();
  bool bad = false;
  for (const auto& [reason, n] : counts.reasons) {
    rejected[reason] = n;
    bad |= reason == "BAD_VALUE" || reason == "MISSING" || reason == "CONFLICT";
  }
  if (o.json) {
    std::cout << Json{{"applied", counts.applied}, {"bodies", counts.bodies}, {"rejected", rejected}}.dump()
              << std::endl;
  } else {
    std::cout << counts.applied << " applied, on " << counts.bodies << " bodies";
    for (const auto& [reason, n] : counts.reasons) std::cout << ", " << n << " rejected: " << reason;
    std::cout << std::endl;
  }
  return bad ? kExitBadInput : counts.applied > 0 ? kExitOk : kExitFailed;
}

CLI::App* AddSpawn(CLI::App& app, SpawnOptions* o) {
  CLI::App* c = app.add_subcommand("spawn", "Add a body to a running world, and print its id");
  AddServer(c, &o->server);
  c->add_option("--shape", o->shape,
                "sphere:RADIUS, box:X,Y,Z (full edges), capsule:RADIUS,HEIGHT, cylinder:RADIUS,HEIGHT")
      ->required();
  c->add_option("--mass", o->mass, "kg")->capture_default_str();
  AddVector(c, "--position", &o->position, "Of the centre of mass, m")->required();
  AddVector(c, "--velocity", &o->velocity, "m/s");
  c->add_flag("--json", o->json, "One JSON object instead of the id");
  c->footer(std::string("Examples:\n"
                        "  aureole spawn --server 127.0.0.1:40001 --shape sphere:0.5 --position 0,10,0\n"
                        "  aureole spawn --server 127.0.0.1:40001 --shape box:1,1,2 --mass 20 --position 3,5,3\n\n") +
            kExitCodesHelp);
  return c;
}

int RunSpawn(const SpawnOptions& o) {
  client::NewBody body;
  if (!ReadShape(o.shape, &body.shape)) {
    std::cerr << "--shape " << o.shape << ": must be such as sphere:0.5, box:1,1,1, capsule:0.3,1 or cylinder:0.3,1\n";
    return kExitBadInput;
  }
  body.mass = o.mass;
  body.position = VectorOf(o.position);
  body.velocity = VectorOf(o.velocity);
  const std::unique_ptr<client::Client> client = ConnectTo(o.server);
  if (client == nullptr) return kExitBadInput;
  std::vector<uint64_t> ids;
  if (const client::Status s = client->Spawn({body}, &ids, kTimeout); !s.ok()) return Report(s);
  if (o.json) {
    std::cout << Json{{"body", ids}}.dump() << std::endl;
  } else {
    for (uint64_t id : ids) std::cout << id << std::endl;
  }
  return kExitOk;
}

CLI::App* AddRay(CLI::App& app, RayOptions* o) {
  CLI::App* c = app.add_subcommand("ray", "What a ray hits first in a running world");
  AddServer(c, &o->server);
  AddVector(c, "--from", &o->from, "m")->required();
  AddVector(c, "--direction", &o->direction, "Of any length but 0")->required();
  c->add_option("--length", o->length, "m")->capture_default_str();
  c->add_flag("--json", o->json, "One JSON object instead of text");
  c->footer(
      std::string("Example:\n"
                  "  aureole ray --server 127.0.0.1:40001 --from 0,50,0 --direction 0,-1,0\n\n"
                  "Exit codes: 0 it hit something; 1 it hit nothing; 2 bad input."));
  return c;
}

int RunRay(const RayOptions& o) {
  const std::unique_ptr<client::Client> client = ConnectTo(o.server);
  if (client == nullptr) return kExitBadInput;
  client::RayHit hit;
  const client::Status s = client->CastRay(VectorOf(o.from), VectorOf(o.direction), o.length, &hit, kTimeout);
  if (!s.ok()) return Report(s);
  const client::Vec3 &p = hit.point, &n = hit.normal;
  if (o.json) {
    Json out = {{"body", hit.body}};
    if (hit.body != 0) {
      out.update(
          {{"fixed", hit.fixed}, {"distance", hit.distance}, {"point", {p.x, p.y, p.z}}, {"normal", {n.x, n.y, n.z}}});
    }
    std::cout << out.dump() << std::endl;
  } else if (hit.body == 0) {
    std::cout << "nothing" << std::endl;
  } else {
    std::cout << absl::StrFormat("body %d%s, %.3f m away, at %.3f, %.3f, %.3f\n", hit.body, hit.fixed ? " (fixed)" : "",
                                 hit.distance, p.x, p.y, p.z)
              << std::flush;
  }
  return hit.body != 0 ? kExitOk : kExitFailed;
}

CLI::App* AddRemove(CLI::App& app, RemoveOptions* o) {
  CLI::App* c = app.add_subcommand("remove", "Remove bodies of a running world");
  AddServer(c, &o->server);
  c->add_option("bodies", o->bodies, "Ids")->required();
  c->add_flag("--json", o->json, "One JSON object instead of text");
  c->footer(
      std::string("Example:\n"
                  "  aureole remove --server 127.0.0.1:40001 7 8 9\n\n"
                  "Exit codes: 0 all were removed; 1 not all were there; 2 bad input."));
  return c;
}

int RunRemove(const RemoveOptions& o) {
  const std::unique_ptr<client::Client> client = ConnectTo(o.server);
  if (client == nullptr) return kExitBadInput;
  int64_t removed = 0;
  if (const client::Status s = client->Remove(o.bodies, &removed, kTimeout); !s.ok()) return Report(s);
  if (o.json) {
    std::cout << Json{{"removed", removed}, {"asked", o.bodies.size()}}.dump() << std::endl;
  } else {
    std::cout << removed << " of " << o.bodies.size() << " removed" << std::endl;
  }
  return removed == static_cast<int64_t>(o.bodies.size()) ? kExitOk : kExitFailed;
}

}  // namespace aureole
