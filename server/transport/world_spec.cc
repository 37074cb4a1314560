#include "server/transport/world_spec.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include <absl/strings/ascii.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <google/protobuf/io/coded_stream.h>
#include <google/protobuf/io/zero_copy_stream_impl_lite.h>

#include "server/transport/input_reader.h"
#include "server/transport/world_bodies.h"
#include "server/transport/world_events.h"
#include "server/transport/world_json.h"
#include "server/transport/world_shapes.h"

namespace aureole {
namespace {

void CheckName(const std::string& name, SpecCheck* check) {
  const bool good = !name.empty() && name.size() <= limits::kMaxNameLength && absl::ascii_islower(name[0]) &&
                    name.back() != '-' && std::all_of(name.begin(), name.end(), [](char c) {
                      return absl::ascii_islower(c) || absl::ascii_isdigit(c) || c == '-';
                    });
  if (good) return;
  check->Fail(Path() / "name", absl::StrCat("must be 1 to ", limits::kMaxNameLength,
                                            " lower-case letters, digits and '-', and begin with a letter"));
}

std::vector<double> Edges(const Path& path, const google::protobuf::RepeatedField<double>& edges, SpecCheck* check) {
  for (int i = 0; i < edges.size(); ++i) check->In(limits::kCoordinate, path[i], edges[i]);
  return {edges.begin(), edges.end()};
}

absl::StatusOr<Layout> ReadCut(const Path& path, const v1::LayoutSpec& spec, SpecCheck* check) {
  switch (spec.cut_case()) {
    case v1::LayoutSpec::kColumns:
      return Layout::Columns(Edges(path / "columns" / "edges", spec.columns().edges(), check));
    case v1::LayoutSpec::kGrid:
      return Layout::Grid(Edges(path / "grid" / "x_edges", spec.grid().x_edges(), check),
                          Edges(path / "grid" / "z_edges", spec.grid().z_edges(), check));
    case v1::LayoutSpec::kBricks:
      for (const auto& [name, edges] :
           {std::pair("x_edges", spec.bricks().x_edges_size()), std::pair("z_edges", spec.bricks().z_edges_size())}) {
        if (edges == 0) check->Fail(path / "bricks" / name, "must be at least one edge; or use columns");
      }
      return Layout::Bricks(Edges(path / "bricks" / "x_edges", spec.bricks().x_edges(), check),
                            Edges(path / "bricks" / "z_edges", spec.bricks().z_edges(), check));
    case v1::LayoutSpec::kRectangles: {
      std::vector<Rect> regions;
      for (int i = 0; i < spec.rectangles().regions_size(); ++i) {
        const v1::LayoutSpec::Rectangle& r = spec.rectangles().regions(i);
        const Path at = (path / "rectangles" / "regions")[i];
        const auto side = [&](const char* name, bool given, double value, double otherwise) {
          return given ? check->In(limits::kCoordinate, at / name, value) : otherwise;
        };
        constexpr double kInf = std::numeric_limits<double>::infinity();
        regions.push_back(
            {side("min_x", r.has_min_x(), r.min_x(), -kInf), side("max_x", r.has_max_x(), r.max_x(), kInf),
             side("min_z", r.has_min_z(), r.min_z(), -kInf), side("max_z", r.has_max_z(), r.max_z(), kInf)});
      }
      return Layout::Rectangles(std::move(regions));
    }
    case v1::LayoutSpec::CUT_NOT_SET:
      return Layout::Columns({});
  }
  return Layout::Columns({});
}

// The layout's own messages begin with the name of the field within `layout.<cut>`, or with `ranks`.
absl::StatusOr<Layout> ReadLayout(const v1::LayoutSpec& spec, SpecCheck* check) {
  static constexpr const char* kCut[] = {"", ".columns", ".grid", ".bricks", ".rectangles"};
  const Path path = Path() / "layout";
  absl::StatusOr<Layout> layout = ReadCut(path, spec, check);
  if (!check->ok()) return check->status();
  if (!layout.ok()) {
    return absl::InvalidArgumentError(absl::StrCat("layout", kCut[spec.cut_case()], ".", layout.status().message()));
  }
  if (layout->size() > limits::kMaxRegions) {
    return absl::InvalidArgumentError(absl::StrCat("layout: must be at most kMaxRegions, ", limits::kMaxRegions,
                                                   ", regions (are ", layout->size(), ")"));
  }
  if (spec.ranks_size() > 0) {
    std::vector<int> ranks;
    // What does not fit in an int is no rank either.
    for (const uint32_t rank : spec.ranks()) ranks.push_back(static_cast<int>(std::min<uint32_t>(rank, 1u << 30)));
    const absl::Status status = layout->SetRanks(std::move(ranks));
    if (!status.ok()) return absl::InvalidArgumentError(absl::StrCat("layout.", status.message()));
  }
  return layout;
}

Environment ReadEnvironment(const v1::WorldSpec& spec, SpecCheck* check) {
  Environment out;
  const Path root;
  if (spec.has_gravity()) out.gravity = check->Vector(limits::kAcceleration, root / "gravity", spec.gravity());
  if (spec.has_tick()) {
    out.tick_us = check->Microseconds(root / "tick", spec.tick(), limits::kMinTickUs, limits::kMaxTickUs);
  }
  out.speed_limit = check->In(limits::kSpeed, root / "speed_limit", spec.speed_limit());
  const Path sleeping = root / "sleeping";
  if (spec.sleeping().has_after()) {
    out.sleep_after =
        static_cast<double>(check->Microseconds(sleeping / "after", spec.sleeping().after(), 0, limits::kMaxTimeUs)) *
        1e-6;
  }
  if (spec.sleeping().has_linear()) {
    out.sleep_linear = check->In(limits::kSpeed, sleeping / "linear", spec.sleeping().linear());
  }
  if (spec.sleeping().has_angular()) {
    out.sleep_angular = check->In(limits::kSpin, sleeping / "angular", spec.sleeping().angular());
  }
  if (spec.has_iterations()) {
    out.iterations = static_cast<int>(check->Whole(root / "iterations", spec.iterations(), 1, limits::kMaxIterations));
  }
  return out;
}

Tolerances ReadTolerances(const v1::Tolerances& spec, int64_t tick_us, SpecCheck* check) {
  Tolerances out;
  const Path path = Path() / "tolerances";
  const int64_t most = limits::kMaxToleranceUs;
  if (spec.has_speed()) out.speed = check->In(limits::kSpeedTolerance, path / "speed", spec.speed());
  if (spec.has_latency()) out.latency_us = check->Microseconds(path / "latency", spec.latency(), 0, most);
  if (spec.has_frame_time()) out.frame_us = check->Microseconds(path / "frame_time", spec.frame_time(), 1, most);
  if (spec.has_clock_skew()) out.skew_us = check->Microseconds(path / "clock_skew", spec.clock_skew(), 0, most);
  out.tick_us = tick_us;
  return out;
}

Exchange ReadExchange(const v1::ExchangeSpec& spec, SpecCheck* check) {
  Exchange out;
  const Path path = Path() / "exchange";
  if (spec.has_delay()) out.k = static_cast<int>(check->Whole(path / "delay", spec.delay(), 0, limits::kMaxDelay));
  if (!v1::ExchangeSpec::Policy_IsValid(spec.policy())) check->Fail(path / "policy", "must be TOLERANCE or REACH");
  if (spec.policy() == v1::ExchangeSpec::REACH) out.policy = AuraPolicy::kReach;
  if (out.k == 0 && spec.policy() != v1::ExchangeSpec::POLICY_UNSPECIFIED) {
    check->Fail(path / "policy",
                "has no meaning in the synchronous exchange; give a delay of 1 or more, or leave it out");
  }
  if (spec.has_return_gap()) out.return_gap = check->In(limits::kReturnGap, path / "return_gap", spec.return_gap());
  if (spec.has_home_slack()) out.home_slack = check->In(limits::kHomeSlack, path / "home_slack", spec.home_slack());
  if (spec.has_dwell()) out.dwell = static_cast<int>(check->Whole(path / "dwell", spec.dwell(), 0, limits::kMaxDwell));
  if (out.k > 0 && (spec.has_return_gap() || spec.has_home_slack() || spec.has_dwell())) {
    check->Fail(path / (spec.has_return_gap()   ? "return_gap"
                        : spec.has_home_slack() ? "home_slack"
                                                : "dwell"),
                "has no meaning with a delay of 1 or more, whose margins follow from the tolerances; leave it out");
  }
  return out;
}

// With k >= 1 a cell must hold a body that nothing foreign can reach: 2 D_pred + D_ret (DESIGN.md section 4, P20), by
// the margins of as many regions as come within D_pred of one point.
void CheckWidths(const World& world, SpecCheck* check) {
  const int k = world.exchange.k;
  if (k == 0 || world.layout.size() == 1) return;
  const double step = world.tolerances.speed * world.environment.dt();
  int m = 2;
  for (int more = m; (more = world.layout.ChainNumber(ComputeMargins(k, m).predict * step)) > m;) m = more;
  const Margins margins = ComputeMargins(k, m);
  const double needed = (2 * margins.predict + margins.give_back) * step;
  const double narrowest = world.layout.NarrowestExtent();
  if (narrowest >= needed) return;
  check->Fail(
      Path() / "layout",
      absl::StrFormat("must have no region narrower than %.6g m for a delay of %d, a speed tolerance of %.6g m/s "
                      "and chains over %d regions (narrowest is %.6g m); make regions wider, or use delay 0",
                      needed, k, world.tolerances.speed, m, narrowest));
}

// Each injector adds what it will have made in the end.
void CheckInjected(int64_t bodies, const World& world, SpecCheck* check) {
  for (size_t i = 0; i < world.injectors.size(); ++i) {
    const Injector& injector = world.injectors[i];
    const double made = std::ceil(injector.rate * injector.duration);
    if (made > static_cast<double>(limits::kMaxBodies - bodies)) {
      return check->Fail((Path() / "injectors")[static_cast<int>(i)] / "rate",
                         absl::StrFormat("times duration must leave the world at most kMaxBodies, %d, bodies (this "
                                         "one makes %.0f); shorten the duration",
                                         limits::kMaxBodies, made));
    }
    bodies += static_cast<int64_t>(made);
  }
}

}  // namespace

absl::StatusOr<World> WorldFromSpec(const v1::WorldSpec& spec) {
  SpecCheck check;
  CheckName(spec.name(), &check);
  if (!check.ok()) return check.status();
  absl::StatusOr<Layout> layout = ReadLayout(spec.layout(), &check);
  if (!layout.ok()) return layout.status();

  World world(*std::move(layout));
  world.name = spec.name();
  if (spec.has_seed()) world.seed = spec.seed();
  world.environment = ReadEnvironment(spec, &check);
  world.tolerances = ReadTolerances(spec.tolerances(), world.environment.tick_us, &check);
  world.exchange = ReadExchange(spec.exchange(), &check);
  if (check.ok()) CheckWidths(world, &check);

  // What has no id gets one in this order.
  BodyReader reader(spec, &check);
  const Path root;
  for (int i = 0; i < spec.bodies_size() && check.ok(); ++i) {
    reader.Dynamic((root / "bodies")[i], spec.bodies(i), &world.bodies);
  }
  if (int64_t{spec.movers_size()} + spec.statics_size() > limits::kMaxFixed) {
    check.Fail(root / "statics", absl::StrCat("must be at most kMaxFixed, ", limits::kMaxFixed, ", with the movers"));
  }
  for (int i = 0; i < spec.movers_size(); ++i) {
    reader.Kinematic((root / "movers")[i], spec.movers(i), &world.environment.fixed);
  }
  for (int i = 0; i < spec.statics_size(); ++i) {
    reader.Static((root / "statics")[i], spec.statics(i), &world.environment.fixed);
  }
  if (check.ok()) ReadJoints(spec, &check, &world);
  if (check.ok()) ReadEvents(spec, &reader, &world);
  if (check.ok()) ReadInjectors(spec, &reader.catalogue, &check, &world);
  ReadClientLimits(spec.client_limits(), &check);
  if (check.ok()) CheckInjected(reader.bodies, world, &check);
  if (!check.ok()) return check.status();
  const auto by_id = [](const BodySpec& a, const BodySpec& b) { return a.id < b.id; };
  std::sort(world.bodies.begin(), world.bodies.end(), by_id);
  std::sort(world.environment.fixed.begin(), world.environment.fixed.end(), by_id);
  return world;
}

absl::StatusOr<World> LoadWorld(std::string_view json) {
  absl::StatusOr<v1::WorldSpec> spec = SpecFromJson(json);
  if (!spec.ok()) return spec.status();
  return WorldFromSpec(*spec);
}

absl::StatusOr<World> LoadWorldFile(const std::string& path) {
  absl::StatusOr<v1::WorldSpec> spec = SpecFromFile(path);
  if (!spec.ok()) return spec.status();
  return WorldFromSpec(*spec);
}

uint64_t WorldHash(const v1::WorldSpec& spec) {
  std::string bytes;
  {
    google::protobuf::io::StringOutputStream stream(&bytes);
    google::protobuf::io::CodedOutputStream coded(&stream);
    coded.SetSerializationDeterministic(true);
    spec.SerializeToCodedStream(&coded);
  }
  uint64_t hash = 0xcbf29ce484222325u;  // FNV-1a
  for (const char c : bytes) hash = (hash ^ static_cast<uint8_t>(c)) * 0x100000001b3u;
  return hash;
}

}  // namespace aureole
