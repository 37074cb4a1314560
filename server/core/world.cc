#include "server/core/world.h"

#include <algorithm>
#include <numeric>
#include <utility>

#include "server/core/check.h"
#include "server/core/union_find.h"

namespace aureole {
namespace {

// Sort and sweep along x.
void UniteNear(const std::vector<BodyView>& views, double margin, UnionFind* components) {
  std::vector<int> order(views.size());
  std::iota(order.begin(), order.end(), 0);
  std::sort(order.begin(), order.end(), [&](int i, int j) {
    const double x = views[i].box.min.x(), y = views[j].box.min.x();
    return x != y ? x < y : i < j;
  });
  std::vector<int> open;  // may still reach the next one in x
  for (const int i : order) {
    std::erase_if(open, [&](int j) { return views[i].box.min.x() - views[j].box.max.x() > margin; });
    for (const int j : open) {
      if (Gap(views[i].box, views[j].box) <= margin) components->Unite(i, j);
    }
    open.push_back(i);
  }
}

int IndexOf(const std::vector<BodyView>& views, BodyId id, JointId joint) {
  const auto it =
      std::lower_bound(views.begin(), views.end(), id, [](const BodyView& v, BodyId wanted) { return v.id < wanted; });
  AUREOLE_CHECK(it != views.end() && it->id == id, "joint %llu joins body %llu, which is not in state 0",
                static_cast<unsigned long long>(joint), static_cast<unsigned long long>(id));
  return static_cast<int>(it - views.begin());
}

// Ticks per k before the first spawn: enough notice for the longest chain, and the same for every layout.
constexpr Tick kFirstSpawn = 8;

constexpr int kLongestChain = 4;

void AppendTick(const World& world, Tick n, std::vector<Input>* out) {
  const auto begin = std::lower_bound(world.script.begin(), world.script.end(), n,
                                      [](const Input& input, Tick tick) { return input.tick < tick; });
  const auto end = std::find_if(begin, world.script.end(), [n](const Input& input) { return input.tick != n; });
  out->insert(out->end(), begin, end);
  InjectorInputs(world.injectors, world.seed, world.environment.tick_us, n, out);
}

}  // namespace

void ScriptedInputs(const World& world, Tick n, std::vector<Input>* out) {
  const Tick first_spawn = kFirstSpawn * world.exchange.k;
  auto is_spawn = [](const Input& i) { return i.kind == Input::Kind::kSpawn; };
  const auto start = static_cast<std::ptrdiff_t>(out->size());
  if (n == first_spawn) {
    for (Tick early = 1; early < n; ++early) AppendTick(world, early, out);
    out->erase(std::remove_if(out->begin() + start, out->end(), [&](const Input& i) { return !is_spawn(i); }),
               out->end());
    for (auto i = out->begin() + start; i != out->end(); ++i) i->tick = n;
  }
  AppendTick(world, n, out);
  if (n < first_spawn) out->erase(std::remove_if(out->begin() + start, out->end(), is_spawn), out->end());
}

std::vector<RegionId> InitialOwners(const World& world, const std::vector<BodyView>& views, double margin) {
  const Layout& layout = world.layout;
  UnionFind components(static_cast<int>(views.size()));
  UniteNear(views, margin, &components);
  for (const JointSpec& joint : world.joints) {
    if (joint.b == 0) continue;
    components.Unite(IndexOf(views, joint.a, joint.id), IndexOf(views, joint.b, joint.id));
  }

  // Members of a component are summed in the order of their ids, so that every region gets the same bits.
  std::vector<std::pair<int, int>> members(views.size());  // root, body
  for (int i = 0; i < components.size(); ++i) members[i] = {components.Find(i), i};
  std::sort(members.begin(), members.end());

  std::vector<RegionId> owners(views.size(), kNoRegion);
  std::vector<double> mass(layout.size());
  for (size_t begin = 0, end = 0; begin < members.size(); begin = end) {
    std::fill(mass.begin(), mass.end(), 0.0);
    for (end = begin; end < members.size() && members[end].first == members[begin].first; ++end) {
      const BodyView& view = views[members[end].second];
      mass[layout.Home(view.centre)] += view.mass;
    }
    RegionId owner = 0;
    for (RegionId r = 1; r < layout.size(); ++r) {
      if (mass[r] > mass[owner] || (mass[r] == mass[owner] && layout.rank(r) < layout.rank(owner))) owner = r;
    }
    for (size_t i = begin; i < end; ++i) owners[members[i].second] = owner;
  }
  return owners;
}

int ChainNumberFor(const World& world) {
  // Regions that come close to one point can meet in one chain. But in a crowd an island finds no quiet moment to go
  // home, and strangers of any region live deep in another: three owners meet on a plain border wherever there are
  // three regions. Four is the most that any search has needed (PROTOCOL.md section 1).
  const double step = world.tolerances.speed * static_cast<double>(world.tolerances.tick_us) * 1e-6;
  const Margins two = ComputeMargins(world.exchange.k, 2);
  const double reach = (two.give_back + static_cast<double>(world.exchange.Dwell())) * step;
  const int least = std::clamp(world.layout.size(), 2, 3);
  return std::clamp(world.layout.ChainNumber(reach), least, kLongestChain);
}

Margins MarginsFor(const World& world) {
  return world.exchange.margins.value_or(ComputeMargins(world.exchange.k, ChainNumberFor(world)));
}

uint64_t BodyHash(BodyId id, uint64_t hash) {
  uint64_t x = id * 0x9e3779b97f4a7c15ull ^ hash;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
  return x ^ (x >> 31);
}

}  // namespace aureole
