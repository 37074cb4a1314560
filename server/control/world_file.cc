#include "server/control/world_file.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>

#include "server/core/aura.h"
#include "server/transport/world_json.h"
#include "server/transport/world_spec.h"

namespace aureole {
namespace {

absl::Status InFile(const std::string& path, const absl::Status& s) {
  if (absl::StartsWith(s.message(), path)) return s;
  return {s.code(), absl::StrCat(path, ": ", s.message())};
}

double Metres(const Tolerances& t, double steps) { return steps * t.speed * static_cast<double>(t.tick_us) * 1e-6; }

// m depends on how far bodies reach within a horizon, and that on m: grow until both agree.
int ChainNumberFor(const World& world, int k) {
  int m = std::max(2, world.layout.ChainNumber(0));
  while (m < world.layout.size()) {
    const int next = world.layout.ChainNumber(Metres(world.tolerances, ComputeMargins(k, m).predict));
    if (next <= m) break;
    m = next;
  }
  return m;
}

uint64_t Injected(const World& world) {
  uint64_t sum = 0;
  for (const Injector& injector : world.injectors) {
    const double end = (injector.start + injector.duration) * 1e6;
    sum += InjectedBy(injector, world.environment.tick_us,
                      static_cast<Tick>(std::ceil(end / static_cast<double>(world.environment.tick_us))) + 1);
  }
  return sum;
}

std::string DescribeExchange(const Exchange& exchange) {
  if (exchange.k == 0) {
    return absl::StrFormat(
        "synchronous (k = 0), nothing is predicted; home again %g m outside, at %g m of space, after %d ticks",
        exchange.home_slack, exchange.return_gap, exchange.Dwell());
  }
  return absl::StrFormat("fixed delay of k = %d ticks, aura policy `%s`", exchange.k,
                         exchange.policy == AuraPolicy::kReach ? "reach" : "tolerance");
}

}  // namespace

absl::StatusOr<WorldFile> OpenWorldFile(const std::string& path, std::optional<uint64_t> seed) {
  absl::StatusOr<v1::WorldSpec> spec = SpecFromFile(path);
  if (!spec.ok()) return InFile(path, spec.status());
  if (seed) spec->set_seed(*seed);
  absl::StatusOr<World> world = WorldFromSpec(*spec);
  if (!world.ok()) return InFile(path, world.status());
  return WorldFile{path, *std::move(spec), *std::move(world)};
}

absl::Status CheckWorld(const v1::WorldSpec& spec) { return WorldFromSpec(spec).status(); }

std::vector<std::string> DescribeWorld(const World& world) {
  std::vector<std::string> out;
  const int regions = world.layout.size();
  out.push_back(
      absl::StrFormat("%s: %d region%s, %d bodies, %d joints, %d fixed and scripted bodies, %d injected later",
                      world.name, regions, regions == 1 ? "" : "s", world.bodies.size(), world.joints.size(),
                      world.environment.fixed.size(), Injected(world)));
  out.push_back(absl::StrCat("exchange: ", DescribeExchange(world.exchange)));
  if (regions == 1) {
    out.push_back("layout: one region; nothing is exchanged");
    return out;
  }
  const Tolerances& t = world.tolerances;
  const bool predicted = world.exchange.k > 0;
  const int k = predicted ? world.exchange.k : ExchangeDelay(t);
  const int m = ChainNumberFor(world, k);
  const Margins margins = ComputeMargins(k, m);
  const PaperAura paper = ComputePaperAura(t);
  const double narrowest = world.layout.NarrowestExtent();
  out.push_back(absl::StrFormat("layout: %s; m = %d regions can chain within one horizon",
                                std::isfinite(narrowest) ? absl::StrFormat("narrowest region %.4g m", narrowest)
                                                         : "no region lies between two others",
                                m));
  out.push_back(absl::StrFormat("paper (Eqs. 1-4): T_R %.1f ms, T_H %.1f ms, T_T %.1f ms; R_a = R_o + %.3f m",
                                static_cast<double>(paper.remote_us) * 1e-3, static_cast<double>(paper.host_us) * 1e-3,
                                static_cast<double>(paper.total_us) * 1e-3, paper.Radius(0, t.speed)));
  out.push_back(absl::StrFormat(
      "ours (k = %d%s, m = %d): predict %g steps = %.3f m, return %g = %.3f m, project %g = %.3f m; spawn notice %d "
      "ticks, reach horizon %d ticks",
      k, predicted ? "" : ", if it were predicted", m, margins.predict, Metres(t, margins.predict), margins.give_back,
      Metres(t, margins.give_back), margins.project, Metres(t, margins.project), margins.spawn_notice,
      margins.horizon));
  return out;
}

Tick TicksIn(double seconds, int64_t tick_us) {
  return std::max<Tick>(1, static_cast<Tick>(std::floor(seconds * 1e6 / static_cast<double>(tick_us) + 1e-6)));
}

}  // namespace aureole
