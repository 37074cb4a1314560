#include "tests/physics/split_run.h"

#include <algorithm>
#include <map>
#include <memory>
#include <random>
#include <set>
#include <sstream>

#include "server/physics/bullet_engine.h"

namespace aureole {
namespace {

class Splitter {
 public:
  Splitter(const PhysicsScene& scene, const SplitOptions& options)
      : scene_(scene), options_(options), random_(options.seed), alone_(MakeBulletEngine(scene.environment)) {
    Environment shuffled = scene.environment;
    std::shuffle(shuffled.fixed.begin(), shuffled.fixed.end(), random_);
    for (int i = 0; i < options.engines; ++i) engines_.push_back(MakeBulletEngine(shuffled));
    for (const BodySpec& b : scene.bodies) alone_->Spawn(b);
    for (const JointSpec& j : scene.joints) alone_->Join(j);

    std::vector<BodySpec> bodies = scene.bodies;
    if (options.unrelated) {
      for (const BodySpec& b : MakeUnrelated(options.seed, 30)) bodies.push_back(b);
    }
    std::shuffle(bodies.begin(), bodies.end(), random_);
    for (const BodySpec& b : bodies) {
      engines_[0]->Spawn(b);
      where_[b.id] = engines_[0].get();
    }
    std::vector<JointSpec> joints = scene.joints;
    std::shuffle(joints.begin(), joints.end(), random_);
    for (const JointSpec& j : joints) engines_[0]->Join(j);
  }

  SplitResult Run(Tick ticks) {
    size_t next = 0;
    for (Tick n = 1; n <= ticks && result_.difference.empty(); ++n) {
      for (; next < scene_.inputs.size() && scene_.inputs[next].tick <= n; ++next) Apply(scene_.inputs[next]);
      Deal(n);
      alone_->Step(n);
      for (auto& e : engines_) e->Step(n);
      for (auto& e : scratch_) e->Step(n);
      Compare(n);
    }
    return result_;
  }

 private:
  void Apply(const Input& input) {
    alone_->Apply(input);
    if (input.kind == Input::Kind::kSpawn) {
      Engine* e = engines_[random_() % engines_.size()].get();
      e->Apply(input);
      where_[input.spawn->id] = e;
      return;
    }
    where_.at(input.body)->Apply(input);
    if (input.kind == Input::Kind::kRemove) where_.erase(input.body);
  }

  // Contact components by exact boxes and joints.
  std::vector<std::vector<BodyId>> Components() const {
    std::vector<BodyView> views;
    for (const auto& [id, e] : where_) views.push_back(e->View(id));
    std::map<BodyId, size_t> index;
    for (size_t i = 0; i < views.size(); ++i) index[views[i].id] = i;
    std::vector<size_t> parent(views.size());
    for (size_t i = 0; i < parent.size(); ++i) parent[i] = i;
    const auto find = [&](size_t i) {
      while (parent[i] != i) i = parent[i] = parent[parent[i]];
      return i;
    };
    std::vector<size_t> order = parent;
    std::sort(order.begin(), order.end(),
              [&](size_t x, size_t y) { return views[x].box.min.x() < views[y].box.min.x(); });
    for (size_t i = 0; i < order.size(); ++i) {
      for (size_t j = i + 1; j < order.size(); ++j) {
        if (views[order[j]].box.min.x() > views[order[i]].box.max.x()) break;
        if (Overlap(views[order[i]].box, views[order[j]].box)) parent[find(order[i])] = find(order[j]);
      }
    }
    std::vector<BodyId> partners;
    for (const auto& [id, e] : where_) {
      partners.clear();
      e->Jointed(id, &partners);
      for (BodyId p : partners) parent[find(index[id])] = find(index[p]);
    }
    std::map<size_t, std::vector<BodyId>> groups;
    for (const auto& [id, i] : index) groups[find(i)].push_back(id);
    std::vector<std::vector<BodyId>> out;
    for (auto& [root, ids] : groups) out.push_back(std::move(ids));
    return out;
  }

  void Deal(Tick n) {
    auto components = Components();
    std::shuffle(components.begin(), components.end(), random_);
    std::vector<std::unique_ptr<Engine>> scratch;
    std::map<std::pair<Engine*, Engine*>, std::vector<BodyId>> moves;
    for (const auto& ids : components) {
      result_.largest = std::max(result_.largest, static_cast<int64_t>(ids.size()));
      if (options_.compare_state && &ids == &components.front()) CompareState(n, ids);
      Engine* to = where_.at(ids.front());
      const bool was_scratch =
          std::any_of(scratch_.begin(), scratch_.end(), [&](const auto& e) { return e.get() == to; });
      if (options_.scratch && random_() % 40 == 0) {
        scratch.push_back(engines_[0]->Scratch());
        to = scratch.back().get();
      } else if (was_scratch || n % options_.deal_every == 0) {
        to = engines_[random_() % engines_.size()].get();
      }
      bool moved = false;
      for (BodyId id : ids) {
        Engine*& from = where_.at(id);
        if (from == to) continue;
        moves[{from, to}].push_back(id);
        from = to;
        ++result_.moves;
        moved = true;
      }
      if (moved && ids.size() > 1) ++result_.touching;
    }
    for (auto& [way, ids] : moves) {
      std::sort(ids.begin(), ids.end());
      const std::string state = way.first->Extract(ids);
      const absl::Status status = way.second->Restore(state);
      if (!status.ok()) result_.difference = std::string(status.message());
    }
    scratch_ = std::move(scratch);
  }

  // The bytes hold contact points and joints too, so they show a difference long before a body moves by it.
  void CompareState(Tick n, const std::vector<BodyId>& ids) {
    if (!alone_->Contains(ids.front())) return;  // unrelated
    Engine* e = where_.at(ids.front());
    for (BodyId id : ids) {
      if (where_.at(id) != e) return;  // just came together
    }
    if (e->Save(ids) == alone_->Save(ids)) return;
    std::ostringstream out;
    out << "tick " << n << ": saved states of a component of " << ids.size() << " bodies differ, first body "
        << ids.front();
    result_.difference = out.str();
  }

  void Compare(Tick n) {
    for (BodyId id : alone_->Ids()) {
      const uint64_t hash = alone_->Hash(id);
      result_.hash = Mix(result_.hash ^ hash);
      const BodyView view = alone_->View(id);
      ++result_.body_ticks;
      result_.asleep += view.asleep ? 1 : 0;
      if (view.asleep) {
        sleepers_.insert(id);
      } else {
        result_.wakes += static_cast<int64_t>(sleepers_.erase(id));
      }
      const Engine* e = where_.at(id);
      if (e->Hash(id) == hash && e->View(id).box == view.box) continue;
      std::ostringstream out;
      out << "tick " << n << ": body " << id << " differs";
      result_.difference = out.str();
      return;
    }
  }

  const PhysicsScene& scene_;
  const SplitOptions options_;
  std::mt19937_64 random_;
  std::unique_ptr<Engine> alone_;
  std::vector<std::unique_ptr<Engine>> engines_, scratch_;
  std::map<BodyId, Engine*> where_;
  std::set<BodyId> sleepers_;
  SplitResult result_;
};

}  // namespace

SplitResult RunSplit(const PhysicsScene& scene, Tick ticks, const SplitOptions& options) {
  return Splitter(scene, options).Run(ticks);
}

uint64_t RunAlone(const PhysicsScene& scene, Tick ticks) {
  const auto engine = MakeBulletEngine(scene.environment);
  for (const BodySpec& b : scene.bodies) engine->Spawn(b);
  for (const JointSpec& j : scene.joints) engine->Join(j);
  size_t next = 0;
  uint64_t hash = 0;
  for (Tick n = 1; n <= ticks; ++n) {
    for (; next < scene.inputs.size() && scene.inputs[next].tick <= n; ++next) engine->Apply(scene.inputs[next]);
    engine->Step(n);
    for (BodyId id : engine->Ids()) hash = Mix(hash ^ engine->Hash(id));
  }
  return hash;
}

}  // namespace aureole
