#include "tests/simulation/cluster.h"

#include <algorithm>
#include <deque>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/core/apply_input.h"
#include "server/core/check.h"
#include "server/core/input_schedule.h"
#include "server/core/region.h"
#include "tests/simulation/layouts.h"
#include "tests/simulation/network.h"

namespace aureole::sim {
namespace {

class Run {
 public:
  Run(const Scenario& scenario, uint64_t seed, const Faults& faults, const EngineFactory& make_engine)
      : s_(scenario),
        world_(scenario.world),
        faults_(faults),
        make_engine_(make_engine),
        rng_(seed ^ 0xfa17),
        crash_rng_(seed ^ 0xdead),
        layout_rng_(seed ^ 0x1a70),
        network_(world_.layout.size(), seed, faults),
        reference_(make_engine(world_.environment)) {
    for (const BodySpec& b : world_.bodies) reference_->Spawn(b);
    for (const JointSpec& j : world_.joints) reference_->Join(j);
    const int n = world_.layout.size();
    stalled_.resize(n);
    lives_.resize(static_cast<size_t>(n));
    if (faults_.layouts && world_.exchange.k == 0) control_.changes = 1 + layout_rng_.Below(4);
    control_.next = 1 + layout_rng_.Below(20);
    std::map<uint64_t, Client> clients;
    for (const Input& i : s_.live) clients[i.source].inputs.push_back(i);
    for (auto& [source, client] : clients) {
      client.region = static_cast<RegionId>(source % static_cast<uint64_t>(n));
      clients_.push_back(std::move(client));
    }
    for (RegionId r = 0; r < n; ++r) {
      regions_.push_back(std::make_unique<Region>(world_, r, make_engine(world_.environment)));
    }
  }

  Verdict Go() {
    for (RegionId r = 0; r < static_cast<int>(regions_.size()); ++r) RunRegion(r);
    while (verdict_.ok && checked_ < s_.ticks) {
      const bool more = network_.RunNext(
          [this](RegionId to, const Frame& f) {
            // A region that has left says all again after a crash, to those too that no longer know it.
            if (f.tick <= regions_[to]->tick() && !StateOf(*regions_[to]).IsMember(f.from)) return;
            const absl::Status s = regions_[to]->Receive(f);
            if (!s.ok()) Fail(f.tick, "receive", std::string(s.message()));
            RunRegion(to);
          },
          [this](RegionId r) {
            if (!lives_[static_cast<size_t>(r)].exists) return;
            if (regions_[r] == nullptr) {
              Restart(r);
            } else {
              stalled_[r] = false;
            }
            RunRegion(r);
          });
      if (faults_.layouts) Drop();
      if (!more && checked_ < s_.ticks && verdict_.ok) Fail(checked_ + 1, "I5", "the regions wait for each other");
    }
    if (verdict_.ok) CheckOutcomes();
    Summarize();
    return verdict_;
  }

 private:
  struct Tally {
    size_t regions = 0, members = 0;
    uint64_t epoch = 0;
    std::vector<BodyRecord> records;
  };

  void RunRegion(RegionId r) {
    if (regions_[r] == nullptr) return;
    Region& region = *regions_[r];
    std::vector<Frame> out;
    while (verdict_.ok && !stalled_[r] && region.Ready()) {
      if (faults_.crashes && crash_rng_.Chance(0.003) && MayCrash()) return Crash(r);
      if (region.phase() == Phase::kJoin) {
        region.Advance(&out);
        // Nobody hears more without it, so it begins where they are.
        Life& life = lives_[static_cast<size_t>(r)];
        if (!life.heard_before) life.heard_before = delivered_.size();
        life.heard = *life.heard_before;
      }
      if (region.phase() == Phase::kBegin) {
        if (region.tick() >= s_.ticks) return;
        if (faults_.crashes) Checkpoint(region);
        OfferLive(region);
        if (faults_.stalls && rng_.Chance(0.01)) {
          ++verdict_.stalls;
          stalled_[r] = true;
          network_.Wake(r, static_cast<int64_t>(rng_.In(1000, 100000)));
          return;
        }
      }
      const Tick before = region.tick();
      if (region.phase() == Phase::kStep) Record(region, before + 1, false);
      if (!verdict_.ok) return;
      out.clear();
      region.Advance(&out);
      TakeInputs(region);
      for (Frame& f : out) {
        const auto frame = std::make_shared<const Frame>(std::move(f));
        for (RegionId p : frame->to) network_.Send(r, p, frame);
      }
      if (region.tick() > before) {
        Record(region, region.tick(), true);
        if (faults_.layouts) Control(region);
      }
    }
  }

  // ---- the control plane ----

  // Decides after each new tick of any region.
  void Control(const Region& region) {
    Life& life = lives_[static_cast<size_t>(region.self())];
    if (region.tick() <= life.controlled) return;
    life.controlled = region.tick();
    if (region.phase() == Phase::kLeft) {
      life.left = true;
      MoveClients(region);
    }
    const bool adopted = control_.offered && region.layout_epoch() == control_.epoch;
    if (adopted) {
      ++verdict_.layouts;
      control_.offered = false;
      control_.next = region.tick() + 1 + layout_rng_.Below(20);
      if (control_.emptying == kNoRegion) --control_.changes;
      if (control_.emptying != kNoRegion && control_.dropping) {
        control_.emptying = kNoRegion;
        --control_.changes;
      }
      if (control_.emptying != kNoRegion) control_.next = region.tick() + (layout_rng_.Chance(0.3) ? 0 : 60);
      control_.since = region.tick();
    }
    if (control_.offered || control_.changes == 0 || region.phase() == Phase::kLeft) return;
    if (control_.emptying != kNoRegion) return FinishRemoval(region);
    if (region.tick() >= control_.next) StartChange(region);
  }

  static Division::State StateOf(const Region& region) {
    return {region.layout(), region.layout_epoch(), region.members()};
  }

  void StartChange(const Region& region) {
    const Division::State now = StateOf(region);
    std::vector<RegionId> with_area;
    for (RegionId r : now.members) {
      if (now.layout.has_area(r)) with_area.push_back(r);
    }
    const int kind = layout_rng_.Below(3);
    if (kind == 0) {
      Offer(region, MoveBorders(now, layout_rng_));
      // Somebody else asks for another at about the same time: one of the two comes to nothing.
      if (layout_rng_.Chance(0.3)) Offer(region, MoveBorders(now, layout_rng_));
    } else if (kind == 1 || with_area.size() < 2) {
      const LayoutChange change = AddRegion(now, NewRegion(), layout_rng_);
      if (layout_rng_.Chance(0.3)) {
        LayoutChange bad = change;
        bad.epoch += static_cast<uint64_t>(layout_rng_.Below(2)) * 2 - 1;
        Offer(region, bad);
      }
      for (RegionId r : change.members) {
        if (!now.IsMember(r)) Create(r, change);
      }
      Offer(region, change);
    } else {
      control_.emptying = with_area[layout_rng_.Below(static_cast<int>(with_area.size()))];
      control_.dropping = false;
      Offer(region, TakeArea(now, control_.emptying, layout_rng_));
    }
  }

  // Of the region that has no area any more. A scene has fewer bodies than may go in one tick, so all do, at once. Now
  // and then it is told to leave before anybody knows that it can.
  void FinishRemoval(const Region& region) {
    if (region.self() == control_.emptying && region.bodies() > 0 && region.tick() > control_.since + 1) {
      return Fail(region.tick(), "layout",
                  absl::StrCat("region ", region.self(), " has no area, but still ", region.bodies(), " bodies"));
    }
    const bool empty = region.self() == control_.emptying && region.bodies() == 0;
    if (!empty && region.tick() < control_.next) return;
    control_.next = std::numeric_limits<Tick>::max();
    control_.dropping = true;
    Offer(region, DropRegion(StateOf(region), control_.emptying));
  }

  // One that never was, or one that has left, whose name is free again.
  RegionId NewRegion() {
    for (size_t r = 0; r < lives_.size(); ++r) {
      // (A checkpoint of somebody may still tell of the one before.)
      if (!lives_[r].exists && !faults_.crashes && layout_rng_.Chance(0.7)) return static_cast<RegionId>(r);
    }
    return static_cast<RegionId>(regions_.size());
  }

  void Create(RegionId r, const LayoutChange& change) {
    const auto index = static_cast<size_t>(r);
    if (index == regions_.size()) {
      regions_.emplace_back();
      lives_.emplace_back();
      stalled_.push_back(false);
    }
    lives_[index] = {};
    lives_[index].joins = change;
    regions_[index] = Join(r);
    network_.Add(r);
    ++verdict_.joined;
  }

  std::unique_ptr<Region> Join(RegionId r) {
    absl::StatusOr<std::unique_ptr<Region>> region =
        Region::Join(world_, r, make_engine_(world_.environment), *lives_[static_cast<size_t>(r)].joins);
    AUREOLE_CHECK(region.ok(), "%s", std::string(region.status().message()).c_str());
    return *std::move(region);
  }

  void Offer(const Region& region, LayoutChange change) {
    Input input;
    input.source = kControlSource;
    input.sequence = ++control_.sequence;
    input.kind = Input::Kind::kLayout;
    control_.epoch = change.epoch;
    control_.offered = true;
    input.layout = std::make_shared<const LayoutChange>(std::move(change));
    control_.waiting.emplace(AnyMember(region, layout_rng_), input);
  }

  // A change that came to nothing may be asked for again.
  void HearOfLayout(const InputOutcome& outcome) {
    if (outcome.refused.empty()) return;
    ++verdict_.refused_layouts;
    if (outcome.name.second != control_.sequence || !control_.offered || !control_.dropping) return;
    control_.offered = false;
    control_.next = std::numeric_limits<Tick>::max();
  }

  // As far as `region` knows; others may know that it has left.
  RegionId AnyMember(const Region& region, Random& rng) const {
    const std::vector<RegionId>& all = region.members();
    const RegionId r = all[rng.Below(static_cast<int>(all.size()))];
    return lives_[static_cast<size_t>(r)].left ? region.self() : r;
  }

  // Regions that have left are there until nobody can need a frame of theirs again.
  void Drop() {
    for (size_t r = 0; r < regions_.size(); ++r) {
      if (regions_[r] == nullptr || regions_[r]->phase() != Phase::kLeft) continue;
      const Tick last = regions_[r]->tick();
      bool needed = false;
      for (size_t other = 0; other < regions_.size(); ++other) {
        if (other == r || !lives_[other].exists) continue;
        const Tick back = faults_.crashes                            ? lives_[other].durable.tick
                          : regions_[other]->phase() == Phase::kJoin ? last
                                                                     : regions_[other]->tick();
        needed |= back < last;
      }
      if (needed) continue;
      network_.Remove(static_cast<RegionId>(r));
      regions_[r] = nullptr;
      lives_[r].exists = false;
      ++verdict_.left;
    }
  }

  // They go elsewhere, and say all again there.
  void MoveClients(const Region& left) {
    const std::vector<RegionId> to = left.next_members().empty() ? left.members() : left.next_members();
    for (Client& client : clients_) {
      if (client.region != left.self()) continue;
      client.region = to[layout_rng_.Below(static_cast<int>(to.size()))];
      client.next = 0;
    }
    for (auto it = control_.waiting.begin(); it != control_.waiting.end();) {
      if (it->first == left.self()) {
        control_.waiting.emplace(to.front(), it->second);
        it = control_.waiting.erase(it);
      } else {
        ++it;
      }
    }
  }

  // What was offered in a tick is durable before anybody hears of it, so after a crash it is offered in the same one.
  void OfferLive(Region& region) {
    Life& life = lives_[static_cast<size_t>(region.self())];
    const Tick n = region.tick();
    furthest_ = std::max(furthest_, n);
    if (faults_.crashes && n <= life.offered) return;
    life.offered = n;
    for (auto [i, end] = life.log.equal_range(n); i != end; ++i) Submit(region, i->second);
    if (MayTakeInputs(region)) OfferOfClients(region);
  }

  // What was told before it died must not be told differently. When all died, nobody knows how far they had come; their
  // logs hold what clients know to be done, and newer inputs must not come before.
  bool MayTakeInputs(const Region& region) const {
    if (!lives_[static_cast<size_t>(region.self())].died) return true;
    const auto logged = [&region](const Life& life) { return region.tick() <= life.log_until; };
    return region.tick() >= known_ && network_.CaughtUp(region.self()) &&
           std::none_of(lives_.begin(), lives_.end(), logged);
  }

  bool Submit(Region& region, const Input& input) {
    const absl::Status s = region.Submit(input);
    if (!s.ok()) Fail(region.tick(), "submit", std::string(s.message()));
    return s.ok();
  }

  // Each client speaks to one region at a time. Now and then it goes to another, as after a lost connection, and says
  // all again there of which it does not know what became.
  void OfferOfClients(Region& region) {
    for (size_t c = 0; c < clients_.size(); ++c) {
      Client& client = clients_[c];
      if (client.region != region.self()) continue;
      for (; client.next < client.inputs.size() && client.inputs[client.next].tick <= furthest_; ++client.next) {
        if (!Submit(region, client.inputs[client.next])) return;
        lives_[static_cast<size_t>(region.self())].log.emplace(region.tick(), client.inputs[client.next]);
        if (client.next >= client.said) ++verdict_.live_inputs;
        client.said = std::max(client.said, client.next + 1);
      }
      if (client.said == 0 || !rng_.Chance(0.02)) continue;
      client.region = AnyMember(region, rng_);
      client.next = 0;
      const auto known = [&](size_t i) {
        return acked_.contains({client.inputs[i].source, client.inputs[i].sequence});
      };
      while (client.next < client.said && known(client.next)) ++client.next;
    }
    for (auto [i, end] = control_.waiting.equal_range(region.self()); i != end; i = control_.waiting.erase(i)) {
      if (!Submit(region, i->second)) return;
      lives_[static_cast<size_t>(region.self())].log.emplace(region.tick(), i->second);
    }
  }

  // One or two at once; now and then, all.
  bool MayCrash() const { return verdict_.crashes < 8 && Dead() < 2; }

  int64_t Dead() const {
    int64_t dead = 0;
    for (size_t r = 0; r < regions_.size(); ++r) dead += lives_[r].exists && regions_[r] == nullptr;
    return dead;
  }

  void Crash(RegionId r) {
    ++verdict_.crashes;
    verdict_.together += Dead();
    regions_[r] = nullptr;
    stalled_[r] = false;
    network_.Down(r);
    network_.Wake(r, static_cast<int64_t>(crash_rng_.In(1000, 300000)));
    RegionId other = r;
    while (other == r) other = static_cast<RegionId>(crash_rng_.Below(static_cast<int>(regions_.size())));
    if (crash_rng_.Chance(0.3) && regions_[other] != nullptr && MayCrash()) Crash(other);
    if (crash_rng_.Chance(0.1)) {
      for (size_t i = 0; i < regions_.size(); ++i) {
        if (regions_[i] != nullptr) Crash(static_cast<RegionId>(i));
      }
    }
    Forget();
  }

  // All are dead. What some had done that others had not, and that no log tells, may come to be otherwise.
  void Forget() {
    if (Dead() <
        static_cast<int64_t>(std::count_if(lives_.begin(), lives_.end(), [](const Life& l) { return l.exists; }))) {
      return;
    }
    known_ = checked_;
    for (const Life& life : lives_) known_ = std::max(known_, life.durable.tick);
    const auto forget = [this](auto* by_tick) { by_tick->erase(by_tick->upper_bound(known_), by_tick->end()); };
    forget(&before_step_);
    forget(&after_step_);
    for (Life& life : lives_) {
      forget(&life.before_step);
      forget(&life.after_step);
    }
  }

  // A checkpoint is durable a while after it was taken. Until then a crash goes back to the one before.
  void Checkpoint(const Region& region) {
    const RegionId r = region.self();
    Life& life = lives_[static_cast<size_t>(r)];
    if (life.writing && region.tick() >= life.durable_at) {
      life.durable = *std::exchange(life.writing, std::nullopt);
      network_.Durable(r, life.durable.taken);
    }
    if (life.writing || !crash_rng_.Chance(0.2)) return;
    Saved saved{region.Save(), region.tick(), life.heard, network_.SendersOf(r), {}};
    for (RegionId peer : region.peers()) saved.taken[peer] = region.FramesTaken(peer);
    life.writing = std::move(saved);
    life.durable_at = region.tick() + crash_rng_.Below(8);
  }

  void Restart(RegionId r) {
    Life& life = lives_[static_cast<size_t>(r)];
    life.writing.reset();
    std::unique_ptr<Engine> engine = make_engine_(world_.environment);
    if (life.durable.state.empty()) {
      regions_[r] = life.joins ? Join(r) : std::make_unique<Region>(world_, r, std::move(engine));
    } else {
      absl::StatusOr<std::unique_ptr<Region>> region = Region::Load(world_, r, std::move(engine), life.durable.state);
      AUREOLE_CHECK(region.ok(), "%s", std::string(region.status().message()).c_str());
      regions_[r] = *std::move(region);
    }
    life.heard = life.durable.heard;
    life.offered = life.durable.tick - 1;
    life.died = true;
    life.log_until = life.log.empty() ? -1 : life.log.rbegin()->first;
    if (!life.after_step.empty()) verdict_.replayed_ticks += life.after_step.rbegin()->first - life.durable.tick;
    network_.Up(r, life.durable.senders, life.durable.taken);
  }

  // All regions are told the same, in the same order.
  void TakeInputs(Region& region) {
    size_t& heard = lives_[static_cast<size_t>(region.self())].heard;
    for (const Input& i : region.TakeDelivered()) {
      if (heard == delivered_.size()) {
        delivered_.push_back(i);
        accepted_.Add(i);
      }
      const Input& first = delivered_[heard++];
      if (first.source != i.source || first.sequence != i.sequence || first.tick != i.tick) {
        return Fail(i.tick, "inputs",
                    absl::StrCat("region ", region.self(), " was told input ", i.sequence, " of client ", i.source,
                                 " where others were told another"));
      }
    }
    for (const InputOutcome& o : region.TakeOutcomes()) {
      if (o.name.first == kControlSource) {
        HearOfLayout(o);
      } else {
        outcomes_.push_back(o);
        acked_.insert(o.name);
      }
    }
  }

  // Not by one that has just gone elsewhere, and found that all ticks are over there.
  bool Said(const InputName& name) const {
    return std::any_of(clients_.begin(), clients_.end(),
                       [&name](const Client& c) { return c.inputs[0].source == name.first && c.next >= name.second; });
  }

  // Every input has one outcome, however often it was said, and it is that of the undivided world.
  void CheckOutcomes() {
    std::set<InputName> known;
    for (const InputOutcome& o : outcomes_) {
      const auto it = acted_.find(o.name);
      if (it == acted_.end() || o != it->second) {
        return Fail(o.tick, "inputs",
                    absl::StrCat("input ", o.name.second, " of client ", o.name.first,
                                 ": the outcome is not that of the undivided world"));
      }
      known.insert(o.name);
    }
    for (const auto& [name, acted] : acted_) {
      if (acted.tick + 2 * world_.exchange.k < checked_ && !known.contains(name) && Said(name)) {
        return Fail(acted.tick, "inputs",
                    absl::StrCat("input ", name.second, " of client ", name.first, " has no outcome"));
      }
    }
  }

  // The first time that a region comes to this point of the tick counts. When it comes again after a crash, all must be
  // as it was.
  void Record(const Region& region, Tick n, bool stepped) {
    std::vector<BodyRecord> records;
    region.Observe(&records);
    const auto layout = layouts_.emplace(region.layout_epoch(), region.layout()).first;
    if (layout->second != region.layout()) {
      return Fail(n, "layout", absl::StrCat("region ", region.self(), " has another of epoch ", layout->first));
    }
    uint64_t hash = records.size() + 1000003 * region.layout_epoch();
    for (const BodyRecord& r : records) hash += BodyHash(r.id, r.hash) * (2 * static_cast<uint64_t>(r.epoch) + 1);
    Life& life = lives_[static_cast<size_t>(region.self())];
    const auto [before, fresh] = (stepped ? life.after_step : life.before_step).emplace(n, hash);
    if (!fresh) {
      if (before->second == hash) return;
      return Fail(n, "replay", absl::StrCat("region ", region.self(), " differs from before it died"));
    }
    Tally& t = (stepped ? after_step_ : before_step_)[n];
    t.records.insert(t.records.end(), records.begin(), records.end());
    if (t.regions++ == 0) t.epoch = region.layout_epoch();
    if (t.epoch != region.layout_epoch()) {
      return Fail(n, "layout",
                  absl::StrCat("region ", region.self(), " has that of epoch ", region.layout_epoch(),
                               ", others have that of epoch ", t.epoch));
    }
    t.members = region.members().size();
    while (verdict_.ok && CheckNext()) {
    }
  }

  // In order: a region that leaves may be slower in its last tick than the others are in the next.
  bool CheckNext() {
    std::map<Tick, Tally>& tallies = stepping_ ? after_step_ : before_step_;
    const Tick n = checked_ + 1;
    const auto it = tallies.find(n);
    if (it == tallies.end() || it->second.regions < it->second.members) return false;
    Tally& t = it->second;
    std::sort(t.records.begin(), t.records.end(), [](const BodyRecord& x, const BodyRecord& y) { return x.id < y.id; });
    if (stepping_) {
      CheckAfterStep(n, t);
    } else {
      CheckBeforeStep(n, t);
    }
    stepping_ = !stepping_;
    tallies.erase(it);
    return true;
  }

  void Fail(Tick n, std::string invariant, std::string message) {
    if (!verdict_.ok) return;
    verdict_.ok = false;
    verdict_.tick = n;
    verdict_.invariant = std::move(invariant);
    verdict_.message = std::move(message);
  }

  // I1, I2, I4 in the state in which everything stands when tick n is stepped.
  void CheckBeforeStep(Tick n, Tally& t) {
    StepReferenceInputs(n);
    for (size_t i = 1; i < t.records.size(); ++i) {
      const BodyRecord &a = t.records[i - 1], &b = t.records[i];
      if (a.id == b.id) return Fail(n, "I1", absl::StrCat("body ", a.id, " is in groups ", a.group, " and ", b.group));
    }
    const std::vector<BodyId> ids = reference_->Ids();
    for (size_t i = 0; i < std::max(ids.size(), t.records.size()); ++i) {
      if (i < ids.size() && (i >= t.records.size() || t.records[i].id > ids[i])) {
        return Fail(n, "I2", absl::StrCat("body ", ids[i], " is nowhere"));
      }
      if (i >= ids.size() || t.records[i].id < ids[i]) {
        return Fail(n, "I2", absl::StrCat("body ", t.records[i].id, " should not be"));
      }
    }
    CheckCohosting(n, t);
    for (const BodyRecord& r : t.records) {
      auto [it, fresh] = groups_.emplace(r.id, r.group);
      it->second = r.group;
    }
    for (const JointSpec& j : world_.joints) {
      if (j.b == 0 || !reference_->Contains(j.a) || !reference_->Contains(j.b)) continue;
      if (groups_.at(j.a) != groups_.at(j.b)) {
        return Fail(n, "I4", absl::StrCat("jointed bodies ", j.a, " and ", j.b, " are stepped apart"));
      }
    }
    for (const BodyRecord& r : t.records) asleep_[r.id] = reference_->View(r.id).asleep;
    reference_->Step(n);
    for (const BodyRecord& r : t.records) verdict_.wakes += asleep_[r.id] && !reference_->View(r.id).asleep;
  }

  void CheckCohosting(Tick n, const Tally& t) {
    std::vector<const BodyRecord*> by_x;
    for (const BodyRecord& r : t.records) by_x.push_back(&r);
    std::sort(by_x.begin(), by_x.end(),
              [](const BodyRecord* x, const BodyRecord* y) { return x->box.min.x() < y->box.min.x(); });
    for (size_t i = 0; i < by_x.size(); ++i) {
      for (size_t j = i + 1; j < by_x.size() && by_x[j]->box.min.x() <= by_x[i]->box.max.x(); ++j) {
        if (by_x[i]->group == by_x[j]->group || !Overlap(by_x[i]->box, by_x[j]->box)) continue;
        return Fail(n, "I4",
                    absl::StrCat("bodies ", by_x[i]->id, " (group ", by_x[i]->group, ") and ", by_x[j]->id, " (group ",
                                 by_x[j]->group, ") overlap and are stepped apart"));
      }
    }
  }

  // I3: the epoch grows with every change of owner, and only then. A body in flight has its new owner's already.
  bool EpochGrew(Tick n, const BodyRecord& r) {
    auto [it, fresh] = owned_.emplace(r.id, std::pair{r.group, r.epoch});
    auto& [owner, epoch] = it->second;
    const bool landed = owner < 0 && r.group >= 0;
    const bool moved = owner != r.group && !(landed && r.epoch == epoch);
    if (!fresh && (moved ? r.epoch <= epoch : r.epoch != epoch)) {
      Fail(n, "I3",
           absl::StrCat("body ", r.id, " went from group ", owner, ", epoch ", epoch, ", to group ", r.group,
                        ", epoch ", r.epoch));
      return false;
    }
    it->second = {r.group, r.epoch};
    return true;
  }

  // I3 and I6 in state n.
  void CheckAfterStep(Tick n, Tally& t) {
    verdict_.hash = 0;
    for (const BodyRecord& r : t.records) {
      if (!EpochGrew(n, r)) return;
      if (!reference_->Contains(r.id)) return Fail(n, "I2", absl::StrCat("body ", r.id, " should not be"));
      if (reference_->Hash(r.id) != r.hash) {
        return Fail(n, "I6", absl::StrCat("body ", r.id, " in group ", r.group, " differs from the undivided world"));
      }
      verdict_.hash += BodyHash(r.id, r.hash);
    }
    verdict_.body_ticks += static_cast<int64_t>(t.records.size());
    checked_ = n;
  }

  void StepReferenceInputs(Tick n) {
    std::vector<Input> inputs;
    ScriptedInputs(world_, n, &inputs);
    accepted_.AppendDue(n, &inputs);
    std::sort(inputs.begin(), inputs.end());
    for (const Input& i : inputs) {
      if (i.kind == Input::Kind::kSpawn) ++verdict_.spawns;
      const int64_t bodies = ApplyInput(i, reference_.get());
      if (i.source == 0 || i.again) continue;
      const InputName name{i.source, i.sequence};
      acted_[name] = {name, n, bodies, i.kind == Input::Kind::kSpawn ? i.body : 0};
    }
  }

  void Summarize() {
    verdict_.reconnects = network_.reconnects();
    verdict_.duplicates = network_.duplicates();
    for (const auto& r : regions_) {
      if (r == nullptr) continue;
      const RegionStats& x = r->stats();
      verdict_.transfers += x.transfers_out;
      verdict_.touching_transfers += x.touching_out;
      verdict_.bodies_moved += x.bodies_out;
      verdict_.returns += x.returns_out;
      verdict_.largest_cluster = std::max(verdict_.largest_cluster, x.largest_cluster);
      verdict_.longest_chain = std::max(verdict_.longest_chain, x.longest_chain);
      verdict_.graphs_again = std::max(verdict_.graphs_again, x.graphs_again);
      verdict_.violations += x.violations;
      verdict_.home_crossings += x.home_crossings;
    }
  }

  const Scenario& s_;
  const World& world_;
  const Faults faults_;
  const EngineFactory& make_engine_;
  Random rng_, crash_rng_, layout_rng_;
  Network network_;
  std::unique_ptr<Engine> reference_;
  std::vector<std::unique_ptr<Region>> regions_;
  std::vector<bool> stalled_;
  // What is left of a region when it dies.
  struct Saved {
    std::string state;
    Tick tick = 0;
    size_t heard = 0;
    Network::Senders senders;
    std::map<RegionId, uint64_t> taken;
  };
  struct Life {
    bool exists = true;
    std::optional<LayoutChange> joins;   // with which it came to be; none: it was there from the beginning
    std::optional<size_t> heard_before;  // of delivered_, when it came
    Tick controlled = 0;
    bool left = false;
    Saved durable;                 // state: empty before the first
    std::optional<Saved> writing;  // durable from this tick on
    Tick durable_at = 0;
    std::multimap<Tick, Input> log;
    bool died = false;
    Tick log_until = -1;                               // of its log, when it died last
    Tick offered = -1;                                 // of this life
    size_t heard = 0;                                  // of delivered_
    std::map<Tick, uint64_t> before_step, after_step;  // what it had, by tick
  };
  std::deque<Life> lives_;  // by region
  std::map<Tick, Tally> before_step_, after_step_;
  std::map<uint64_t, Layout> layouts_;  // by epoch
  struct {
    int changes = 0;  // to come
    Tick next = 0;    // when
    uint64_t sequence = 0, epoch = 0;
    bool offered = false;                    // a change to this epoch
    RegionId emptying = kNoRegion;           // loses its area, then leaves
    bool dropping = false;                   // it is to leave with the change that was offered
    Tick since = 0;                          // when the last change came into force
    std::multimap<RegionId, Input> waiting;  // to be offered to that region
  } control_;
  InputSchedule accepted_;
  struct Client {
    std::vector<Input> inputs;
    RegionId region = 0;
    size_t next = 0, said = 0;  // of its inputs
  };
  std::vector<Client> clients_;
  std::vector<Input> delivered_;             // as the first region heard them
  std::map<InputName, InputOutcome> acted_;  // in the undivided world
  std::vector<InputOutcome> outcomes_;
  std::set<InputName> acked_;  // that have one
  Tick known_ = 0;             // to which all had come when all died, or from which one goes on
  Tick furthest_ = 0;          // of any region, ever: the time of clients, who do not go back with those that die
  std::map<BodyId, int64_t> groups_;
  std::map<BodyId, bool> asleep_;
  std::map<BodyId, std::pair<int64_t, Epoch>> owned_;  // group and epoch when last seen
  Tick checked_ = 0;
  bool stepping_ = false;  // the one after it is checked as far as its step
  Verdict verdict_;
};

}  // namespace

Verdict RunCluster(const Scenario& scenario, uint64_t seed, const Faults& faults, const EngineFactory& make_engine) {
  return Run(scenario, seed, faults, make_engine).Go();
}

}  // namespace aureole::sim
