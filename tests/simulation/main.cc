// aureole-sim: the cluster simulation from the command line.
#include <atomic>
#include <chrono>
#include <cstdio>
#include <map>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <CLI/CLI.hpp>

#include "server/core/toy_engine.h"
#include "server/physics/bullet_engine.h"
#include "tests/simulation/cluster.h"

namespace aureole::sim {
namespace {

struct Totals {
  int64_t seeds = 0, bad = 0, over_100_touching = 0;
  int64_t transfers = 0, touching = 0, returns = 0, wakes = 0, spawns = 0, live = 0;
  int64_t reconnects = 0, duplicates = 0, stalls = 0, violations = 0, graphs_again = 0;
  int64_t crashes = 0, replayed = 0, together = 0;
  int64_t layouts = 0, joined = 0, left = 0, refused_layouts = 0;
  int64_t largest_cluster = 0;
  std::map<int64_t, int64_t> chains;  // longest chain -> seeds
  std::map<std::string, int64_t> kinds;
  uint64_t hash = 0;
};

const char* PolicyName(const World& w) {
  if (w.exchange.k == 0) return "synchronous";
  return w.exchange.policy == AuraPolicy::kReach ? "reach" : "tolerance";
}

void Add(const Scenario& s, const Verdict& v, Totals* t) {
  ++t->seeds;
  t->bad += !v.ok;
  t->over_100_touching += v.touching_transfers > 100;
  t->transfers += v.transfers;
  t->touching += v.touching_transfers;
  t->returns += v.returns;
  t->wakes += v.wakes;
  t->spawns += v.spawns;
  t->live += v.live_inputs;
  t->reconnects += v.reconnects;
  t->duplicates += v.duplicates;
  t->stalls += v.stalls;
  t->crashes += v.crashes;
  t->replayed += v.replayed_ticks;
  t->together += v.together;
  t->layouts += v.layouts;
  t->joined += v.joined;
  t->left += v.left;
  t->refused_layouts += v.refused_layouts;
  t->violations += v.violations;
  t->graphs_again += v.graphs_again;
  t->largest_cluster = std::max(t->largest_cluster, v.largest_cluster);
  ++t->chains[v.longest_chain];
  ++t->kinds["k=" + std::to_string(s.world.exchange.k) + " " + PolicyName(s.world)];
  t->hash += v.hash;
}

struct Options {
  int64_t seeds = 100;
  uint64_t first = 1;
  bool verbose = false;
  int jobs = 2;
  Faults faults;
  ScenarioOptions scenario;
};

int RunAll(const Options& o) {
  const EngineFactory make = o.scenario.toy ? EngineFactory(MakeToyEngine) : EngineFactory(MakeBulletEngine);
  std::atomic<int64_t> next{0};
  std::mutex mutex;
  Totals totals;
  auto work = [&] {
    for (int64_t i = next++; i < o.seeds; i = next++) {
      const uint64_t seed = o.first + static_cast<uint64_t>(i);
      const Scenario s = MakeScenario(seed, o.scenario, make);
      const Verdict v = RunCluster(s, seed, o.faults, make);
      const std::lock_guard lock(mutex);
      Add(s, v, &totals);
      if (!v.ok || o.verbose) {
        std::printf("seed %llu: %s k=%d %s, %s on %s, %lld ticks, %zu bodies: %s",
                    static_cast<unsigned long long>(seed), v.ok ? "ok" : "BAD", s.world.exchange.k, PolicyName(s.world),
                    s.scene.c_str(), s.layout.c_str(), static_cast<long long>(s.ticks), s.world.bodies.size(),
                    v.ok ? "" : v.invariant.c_str());
        if (!v.ok) std::printf(" at tick %lld: %s", static_cast<long long>(v.tick), v.message.c_str());
        std::printf(" (%lld touching transfers, chain %lld, largest %lld)\n",
                    static_cast<long long>(v.touching_transfers), static_cast<long long>(v.longest_chain),
                    static_cast<long long>(v.largest_cluster));
        if (!v.ok) {
          const Verdict calm = RunCluster(s, seed, Faults::None(), make);
          std::printf("  without faults: %s; replay: aureole-sim --seeds 1 --first %llu%s\n",
                      calm.ok ? "ok" : "the same invariant breaks", static_cast<unsigned long long>(seed),
                      o.scenario.toy ? " --toy" : "");
        }
        std::fflush(stdout);
      }
    }
  };
  std::vector<std::thread> threads;
  for (int i = 1; i < o.jobs; ++i) threads.emplace_back(work);
  work();
  for (std::thread& t : threads) t.join();

  std::printf("%lld seeds, %lld bad\n", static_cast<long long>(totals.seeds), static_cast<long long>(totals.bad));
  for (const auto& [kind, n] : totals.kinds)
    std::printf("  %-18s %lld seeds\n", kind.c_str(), static_cast<long long>(n));
  std::printf("  transfers %lld, of touching bodies %lld, returns %lld; largest cluster %lld\n",
              static_cast<long long>(totals.transfers), static_cast<long long>(totals.touching),
              static_cast<long long>(totals.returns), static_cast<long long>(totals.largest_cluster));
  std::printf(
      "  seeds with more than 100 transfers of touching bodies: %.1f %%\n",
      100.0 * static_cast<double>(totals.over_100_touching) / static_cast<double>(std::max<int64_t>(1, totals.seeds)));
  std::printf("  longest chain of owners:");
  for (const auto& [chain, n] : totals.chains) {
    std::printf(" %lld in %lld seeds;", static_cast<long long>(chain), static_cast<long long>(n));
  }
  std::printf("\n  wakes %lld, spawns %lld, live inputs %lld, ticks with late boxes %lld\n",
              static_cast<long long>(totals.wakes), static_cast<long long>(totals.spawns),
              static_cast<long long>(totals.live), static_cast<long long>(totals.graphs_again));
  std::printf("  reconnects %lld, duplicates %lld, stalls %lld, broken horizons %lld\n",
              static_cast<long long>(totals.reconnects), static_cast<long long>(totals.duplicates),
              static_cast<long long>(totals.stalls), static_cast<long long>(totals.violations));
  if (o.faults.crashes) {
    std::printf("  crashes %lld, while another was dead %lld, ticks replayed %lld\n",
                static_cast<long long>(totals.crashes), static_cast<long long>(totals.together),
                static_cast<long long>(totals.replayed));
  }
  if (o.faults.layouts) {
    std::printf("  layouts %lld, regions joined %lld, left %lld; layouts refused %lld\n",
                static_cast<long long>(totals.layouts), static_cast<long long>(totals.joined),
                static_cast<long long>(totals.left), static_cast<long long>(totals.refused_layouts));
  }
  std::printf("  hash %016llx\n", static_cast<unsigned long long>(totals.hash));
  return totals.bad == 0 ? 0 : 1;
}

bool ParseFaults(const std::string& list, Faults* f) {
  if (list == "all") {
    f->crashes = f->layouts = true;
    return true;
  }
  *f = Faults::None();
  if (list == "none") return true;
  const std::map<std::string, bool*> names{
      {"delay", &f->delay},   {"jitter", &f->jitter},   {"duplicates", &f->duplicates}, {"reconnects", &f->reconnects},
      {"stalls", &f->stalls}, {"crashes", &f->crashes}, {"layouts", &f->layouts}};
  for (const std::string& name : CLI::detail::split(list, ',')) {
    auto it = names.find(name);
    if (it == names.end()) return false;
    *it->second = true;
  }
  return true;
}

int Main(int argc, char** argv) {
  CLI::App app{
      "Simulates clusters of regions in one thread from seeds, with a faulty network, and compares every tick\n"
      "with the undivided world: I1 one owner, I2 nothing vanishes, I3 epochs grow, I4 what overlaps is stepped\n"
      "together, I5 nobody waits for ever, I6 the same bits. Exit code 0: all hold; 1: a seed is bad; 2: usage."};
  app.footer(
      "Examples:\n  aureole-sim --toy --seeds 10000\n  aureole-sim --seeds 1 --first 4711 --verbose\n"
      "  aureole-sim --toy --k 2 --policy tolerance --layout grid4 --scene burst --margin predict=7.7");
  Options o;
  std::string faults = "all", policy;
  int k = -1;
  std::string scene, layout;
  std::vector<std::string> margins;
  bool no_returns = false;
  app.add_option("--seeds", o.seeds, "number of seeds")->check(CLI::PositiveNumber);
  app.add_option("--first", o.first, "first seed");
  app.add_flag("--toy", o.scenario.toy, "the toy engine instead of Bullet");
  app.add_option("--faults", faults,
                 "all, none, or a list of delay,jitter,duplicates,reconnects,stalls,crashes,layouts");
  app.add_option("--k", k, "delay of the exchange in ticks (default: by seed)")->check(CLI::Range(0, 3));
  app.add_option("--policy", policy, "tolerance or reach (default: by seed)")
      ->check(CLI::IsMember({"tolerance", "reach"}));
  app.add_option("--scene", scene, "kind of scene (default: by seed)")->check(CLI::IsMember(Scenes()));
  app.add_option("--layout", layout, "kind of layout (default: by seed)")->check(CLI::IsMember(Layouts()));
  app.add_option("--margin", margins,
                 "NAME=STEPS: replaces a margin (predict, give_back, project, spawn_notice, horizon)");
  app.add_flag("--no-returns", no_returns, "islands never go home");
  app.add_option("--jobs", o.jobs, "threads")->check(CLI::Range(1, 64));
  app.add_flag("--verbose", o.verbose, "a line for every seed");
  o.scenario.toy = false;
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    return app.exit(e) == 0 ? 0 : 2;
  }
  if (!ParseFaults(faults, &o.faults)) {
    std::fprintf(stderr, "--faults: unknown fault in '%s'\n", faults.c_str());
    return 2;
  }
  if (k >= 0) o.scenario.k = k;
  if (!policy.empty()) o.scenario.policy = policy == "reach" ? AuraPolicy::kReach : AuraPolicy::kTolerance;
  if (!scene.empty()) o.scenario.scene = scene;
  if (!layout.empty()) o.scenario.layout = layout;
  o.scenario.returns = !no_returns;
  for (const std::string& m : margins) {
    const size_t eq = m.find('=');
    const std::string name = m.substr(0, eq);
    if (eq == std::string::npos) {
      std::fprintf(stderr, "--margin: write NAME=STEPS, not '%s'\n", m.c_str());
      return 2;
    }
    o.scenario.margin_overrides[name] = std::stod(m.substr(eq + 1));
  }
  return RunAll(o);
}

}  // namespace
}  // namespace aureole::sim

int main(int argc, char** argv) { return aureole::sim::Main(argc, argv); }
