#include "server/transport/replica_publisher.h"

#include <algorithm>
#include <cmath>

#include <absl/container/flat_hash_map.h>
#include <absl/container/flat_hash_set.h>

#include "aureole/v1/simulation.pb.h"
#include "server/transport/wire.h"

namespace aureole {
namespace {

constexpr double kDefaultRate = 20, kMaxRate = 1000;  // per second
constexpr Tick kMaxPeriod = 1024;
// A view of more cells than this is watched like the whole world.
constexpr size_t kMostCells = 4096;
// Of a frame that brings much into view: the rest comes in the next ones.
constexpr size_t kMostNewBytes = size_t{1} << 20, kDescriptionBytes = 10;
// Ticks after which what became of a body is forgotten, and seconds that the pace is taken over.
constexpr Tick kKeptFates = 4096;
constexpr std::chrono::seconds kPaceOver(1);

template <class List>
auto FindCell(const List& cells, const CellKey& key) {
  const auto it =
      std::lower_bound(cells.begin(), cells.end(), key, [](const auto& c, const CellKey& k) { return c.first < k; });
  return it != cells.end() && it->first == key ? it : cells.end();
}

}  // namespace

ReplicaRequest ReplicaRequest::Read(const Path& path, const v1::StreamReplicasRequest& request, int64_t tick_us,
                                    SpecCheck* check) {
  ReplicaRequest out;
  const double rate =
      request.rate() == 0 ? kDefaultRate : check->Positive({0, kMaxRate, "per second"}, path / "rate", request.rate());
  const double ticks = 1e6 / (static_cast<double>(tick_us) * std::max(rate, 1e-3));
  out.period = static_cast<Tick>(std::clamp(std::nearbyint(ticks), 1.0, static_cast<double>(kMaxPeriod)));
  if (!v1::Precision_IsValid(request.precision())) check->Fail(path / "precision", "must be FINE, COARSE or EXACT");
  if (!v1::CellEncoding_IsValid(request.encoding())) check->Fail(path / "encoding", "must be COLUMNS or BITS");
  out.format.precision = static_cast<Precision>(request.precision());
  out.format.velocities = request.velocities();
  out.format.layout = request.encoding() == v1::BITS ? CellLayout::kBits : CellLayout::kColumns;
  if (out.format.precision == Precision::kExact && out.format.layout == CellLayout::kBits) {
    check->Fail(path / "encoding", "must be COLUMNS with precision EXACT", v1::CONFLICT);
  }
  out.view = CellView(path / "view", request.view(), check);
  if (check->ok()) out.cells = out.view.Cells(kMostCells);
  out.detail = DetailLevels(path / "level_of_detail", request.level_of_detail(), check);
  out.key = request.SerializeAsString();
  return out;
}

ReplicaPublisher::ReplicaPublisher() : empty_(std::make_unique<Capture>()), thread_([this] { Loop(); }) {}

ReplicaPublisher::~ReplicaPublisher() {
  {
    const std::lock_guard lock(mutex_);
    ended_ = true;
  }
  changed_.notify_all();
  thread_.join();
}

void ReplicaPublisher::Serve(RegionId region, uint64_t layout_epoch, int64_t tick_us) {
  const std::lock_guard lock(mutex_);
  region_ = region;
  layout_epoch_ = layout_epoch;
  tick_us_ = tick_us;
}

void ReplicaPublisher::Stop(const grpc::Status& status) {
  {
    const std::lock_guard lock(mutex_);
    stopped_ = status;
    woken_ = true;
  }
  changed_.notify_all();
}

void ReplicaPublisher::Join(std::shared_ptr<ReplicaSubscriber> subscriber) {
  {
    const std::lock_guard lock(mutex_);
    joining_.push_back(std::move(subscriber));
    woken_ = true;
  }
  changed_.notify_all();
}

void ReplicaPublisher::Wake() {
  {
    const std::lock_guard lock(mutex_);
    woken_ = true;
  }
  changed_.notify_all();
}

void ReplicaPublisher::AfterTick(Region* region) {
  if (!watched_) return capture_.Stop(region);
  std::shared_ptr<const Watch> watch;
  std::unique_ptr<Capture> capture;
  {
    const std::lock_guard lock(mutex_);
    watch = watch_;
    if (watch == nullptr || !capture_.Due(*watch, region->tick())) return;
    capture = std::move(empty_);  // null: the thread has not yet taken the one before; it gets the next
  }
  if (capture == nullptr) return;
  capture_.Take(region, std::move(watch), capture.get());
  {
    const std::lock_guard lock(mutex_);
    full_ = std::move(capture);
  }
  changed_.notify_all();
}

void ReplicaPublisher::Loop() {
  std::unique_lock lock(mutex_);
  while (!ended_) {
    changed_.wait(lock, [this] { return ended_ || woken_ || full_ != nullptr; });
    std::unique_ptr<Capture> capture = std::move(full_);
    const std::optional<grpc::Status> stopped = stopped_;
    woken_ = false;
    lock.unlock();
    TakeRequests();
    if (stopped.has_value()) EndAll(*stopped);
    if (capture != nullptr) {
      scene_.Apply(*capture);
      lock.lock();
      empty_ = std::move(capture);
      lock.unlock();
      pace_.emplace_back(Clock::now(), scene_.tick());
      Publish();
      published_ = scene_.tick();
    }
    lock.lock();
  }
}

// Puts each subscriber into the audience of what it wants, and lets go of those that are gone.
void ReplicaPublisher::TakeRequests() {
  std::vector<Member> moving;
  {
    const std::lock_guard lock(mutex_);
    for (auto& s : joining_) moving.push_back({std::move(s), nullptr});
    joining_.clear();
  }
  bool changed = !moving.empty();
  std::vector<std::pair<Member, std::shared_ptr<const ReplicaRequest>>> placed;
  for (Member& m : moving) {
    std::shared_ptr<const ReplicaRequest> request = m.subscriber->TakeRequest();
    placed.emplace_back(std::move(m), std::move(request));
  }
  for (auto& [key, audience] : audiences_) {
    std::erase_if(audience.members, [&](Member& m) {
      if (m.subscriber->Poll() == ReplicaSubscriber::State::kGone) return changed = true;
      std::shared_ptr<const ReplicaRequest> request = m.subscriber->TakeRequest();
      if (request == nullptr) return false;
      placed.emplace_back(std::move(m), std::move(request));
      return changed = true;
    });
  }
  for (auto& [member, request] : placed) {
    Audience& audience = audiences_[request->key];
    audience.request = request;
    audience.members.push_back(std::move(member));
  }
  if (!changed) return;
  std::erase_if(audiences_, [](const auto& e) { return e.second.members.empty(); });
  ChooseWatch();
}

void ReplicaPublisher::EndAll(const grpc::Status& status) {
  for (auto& [key, audience] : audiences_) {
    for (Member& m : audience.members) m.subscriber->End(status);
  }
  TakeRequests();
}

void ReplicaPublisher::ChooseWatch() {
  std::shared_ptr<Watch> watch;
  int64_t subscribers = 0;
  ++generation_;
  for (auto& [key, audience] : audiences_) {
    if (watch == nullptr) watch = std::make_shared<Watch>();
    watch->generation = generation_;
    if (audience.watch == 0) audience.watch = generation_;
    subscribers += static_cast<int64_t>(audience.members.size());
    const ReplicaRequest& r = *audience.request;
    if (std::find(watch->periods.begin(), watch->periods.end(), r.period) == watch->periods.end()) {
      watch->periods.push_back(r.period);
    }
    if (watch->everything) continue;
    if (!r.cells.has_value() || watch->cells.size() + r.cells->size() > kMostCells) {
      watch->everything = true;
      watch->cells.clear();
    } else {
      watch->cells.insert(r.cells->begin(), r.cells->end());
    }
  }
  if (watch != nullptr) watch->rects = RectsOf({watch->cells.begin(), watch->cells.end()});
  subscribers_ = subscribers;
  const std::lock_guard lock(mutex_);
  watched_ = watch != nullptr;
  watch_ = std::move(watch);
}

void ReplicaPublisher::Publish() {
  encoded_.clear();
  bool gone = false;
  for (auto& [key, audience] : audiences_) {
    if (scene_.tick() % audience.request->period != 0) continue;
    if (scene_.watch_generation() < audience.watch) continue;  // captured before it was known
    std::shared_ptr<const Shown> shown;
    // By what they were told before.
    std::map<const Shown*, Frame> frames;
    for (Member& m : audience.members) {
      const ReplicaSubscriber::State state = m.subscriber->Poll();
      gone |= state == ReplicaSubscriber::State::kGone;
      if (state != ReplicaSubscriber::State::kReady) continue;
      if (shown == nullptr) shown = audience.last = Show(audience);
      const auto [it, fresh] = frames.try_emplace(m.base.get());
      if (fresh) it->second = MakeFrame(audience, m.base.get(), shown);
      if (!m.subscriber->Send(it->second.bytes, scene_.tick())) continue;
      m.base = it->second.shown;
      bytes_sent_ += static_cast<int64_t>(it->second.bytes.size());
    }
  }
  if (scene_.tick() % kKeptFates == 0) scene_.Forget(scene_.tick() - kKeptFates);
  if (gone) TakeRequests();
}

// What its view shows now. Cells that are not due in this frame stay as they were shown last.
std::shared_ptr<const ReplicaPublisher::Shown> ReplicaPublisher::Show(const Audience& audience) {
  const ReplicaRequest& request = *audience.request;
  auto out = std::make_shared<Shown>();
  out->tick = scene_.tick();
  std::vector<CellKey> cells;
  if (request.cells.has_value() && request.cells->size() < 4 * scene_.cells() + 64) {
    cells = *request.cells;
  } else {
    scene_.ForEachCell([&](const CellKey& key) {
      if (request.view.Selects(key)) cells.push_back(key);
    });
    if (audience.last != nullptr && !request.detail.full()) {
      for (const auto& [key, state] : audience.last->cells) cells.push_back(key);
    }
    std::sort(cells.begin(), cells.end());
    cells.erase(std::unique(cells.begin(), cells.end()), cells.end());
  }
  ShowCells(audience, cells, out.get());
  return out;
}

void ReplicaPublisher::ShowCells(const Audience& audience, const std::vector<CellKey>& cells, Shown* out) {
  const ReplicaRequest& request = *audience.request;
  const Precision precision = request.format.precision;
  const Tick frame = scene_.tick() / request.period;
  std::vector<std::pair<CellKey, std::shared_ptr<const CellState>>> shown;
  absl::flat_hash_map<CellKey, std::shared_ptr<const CellState>> held;  // cells that are not due
  const bool joins =
      std::any_of(audience.members.begin(), audience.members.end(), [](const Member& m) { return m.base == nullptr; });
  for (const CellKey& key : cells) {
    // Due at multiples; one that fell into a frame that nobody took is made up for.
    const int every = request.detail.Every(key);
    const bool made = audience.last != nullptr && frame / every == audience.last->tick / request.period / every;
    // What another server handed over is told here at once; a new reader is told everything as it is now.
    if (every > 1 && made && !joins && scene_.LastArrival(key) <= audience.last->tick) {
      const auto before = FindCell(audience.last->cells, key);
      if (before != audience.last->cells.end()) {
        held.emplace(key, before->second);
        continue;
      }
    }
    shown.emplace_back(key, scene_.State(key, precision));
  }
  // A body is shown in one cell: what crosses between a due cell and a held one makes that one due.
  for (size_t next = 0; !held.empty() && next < shown.size();) {
    absl::flat_hash_map<BodyId, CellKey> held_at;
    for (const auto& [key, state] : held) {
      for (const CellBody& b : state->bodies) held_at.emplace(b.id, key);
    }
    const size_t end = shown.size();
    absl::flat_hash_set<CellKey> due;
    for (; next < end; ++next) {
      const auto& [key, state] = shown[next];
      if (state != nullptr) {
        for (const CellBody& b : state->bodies) {
          if (const auto at = held_at.find(b.id); at != held_at.end()) due.insert(at->second);
        }
      }
      const auto before = FindCell(audience.last->cells, key);
      if (before == audience.last->cells.end()) continue;
      for (const CellBody& b : before->second->bodies) {
        const CellKey* now = scene_.CellOfBody(b.id);
        if (now != nullptr && held.contains(*now)) due.insert(*now);
      }
    }
    for (const CellKey& key : due) {
      held.erase(key);
      shown.emplace_back(key, scene_.State(key, precision));
    }
  }
  for (auto& [key, state] : held) shown.emplace_back(key, std::move(state));
  std::erase_if(shown, [](const auto& c) { return c.second == nullptr; });
  std::sort(shown.begin(), shown.end(), [](const auto& x, const auto& y) { return x.first < y.first; });
  out->cells = std::move(shown);
}

ReplicaPublisher::Frame ReplicaPublisher::MakeFrame(const Audience& audience, const Shown* base,
                                                    const std::shared_ptr<const Shown>& shown) {
  static const Shown kNothing;
  const CellFormat& format = audience.request->format;
  const Shown& from = base != nullptr ? *base : kNothing;
  v1::ReplicaFrame head;
  head.set_tick(shown->tick);
  head.set_base_tick(from.tick);
  head.set_region(region_);
  head.set_layout_epoch(layout_epoch_);
  head.set_real_time_factor(RealTimeFactor());

  std::string cells;
  std::vector<BodyId> entered, left;
  const auto add = [&](const CellState* before, const CellState* now) {
    const EncodedCell& cell = Encoded(before, now, format);
    if (!cell.bytes.empty()) cells += FieldHead(v1::ReplicaFrame::kCellsFieldNumber, cell.bytes.size()) + cell.bytes;
    entered.insert(entered.end(), cell.entered.begin(), cell.entered.end());
    left.insert(left.end(), cell.left.begin(), cell.left.end());
  };
  auto partial = std::make_shared<Shown>();  // when not all fits
  partial->tick = shown->tick;
  bool all = true;
  size_t i = 0, j = 0;
  while (i < from.cells.size() || j < shown->cells.size()) {
    const bool gone =
        j == shown->cells.size() || (i < from.cells.size() && from.cells[i].first < shown->cells[j].first);
    if (gone) {
      const auto& [key, before] = from.cells[i++];
      if (audience.request->view.Selects(key)) {
        add(before.get(), nullptr);
      } else {
        head.add_dropped(key.x);
        head.add_dropped(key.z);
      }
      continue;
    }
    const auto& [key, now] = shown->cells[j++];
    const bool known = i < from.cells.size() && from.cells[i].first == key;
    if (!known && cells.size() + kDescriptionBytes * entered.size() > kMostNewBytes) {
      all = false;
      continue;
    }
    partial->cells.emplace_back(key, now);
    const CellState* before = known ? from.cells[i++].second.get() : nullptr;
    if (before != now.get()) add(before, now.get());
  }
  head.set_more(!all);
  std::sort(entered.begin(), entered.end());
  std::sort(left.begin(), left.end());
  if (base != nullptr) AddPassed(audience, from.tick, left, &head);
  std::string bytes = head.SerializeAsString();
  std::vector<BodyId> fresh;
  std::set_difference(entered.begin(), entered.end(), left.begin(), left.end(), std::back_inserter(fresh));
  AppendDescriptions(fresh, &bytes);
  bytes += cells;
  return {grpc::Slice(bytes), all ? shown : std::shared_ptr<const Shown>(std::move(partial))};
}

void ReplicaPublisher::AppendDescriptions(const std::vector<BodyId>& ids, std::string* out) const {
  std::map<std::string_view, std::vector<BodyId>> by_look;
  for (BodyId id : ids) {
    if (const std::string* look = scene_.Look(id)) by_look[*look].push_back(id);
  }
  v1::ReplicaFrame frame;
  for (const auto& [look, bodies] : by_look) {
    v1::BodyDescription* d = frame.add_described();
    d->ParseFromArray(look.data(), static_cast<int>(look.size()));
    BodyId last = 0;
    for (BodyId id : bodies) d->add_body(id - std::exchange(last, id));
  }
  frame.AppendToString(out);
}

// Bodies that this server handed on before the stream was told of them.
void ReplicaPublisher::AddPassed(const Audience& audience, Tick since, const std::vector<BodyId>& left,
                                 v1::ReplicaFrame* out) const {
  std::map<BodyId, const BodyChanges::Gone*> passed;  // the last time
  scene_.ForEachHandOver(since, [&](const BodyChanges::Gone& g) {
    if (std::binary_search(left.begin(), left.end(), g.id) || scene_.CellOfBody(g.id) != nullptr) return;
    if (audience.request->view.Selects(CellOf(g.at))) passed[g.id] = &g;
  });
  BodyId last = 0;
  for (const auto& [id, g] : passed) {
    out->add_passed(id - std::exchange(last, id));
    out->add_passed_region(static_cast<uint32_t>(g->to));
    out->add_passed_epoch(g->epoch);
    out->add_passed_tick(static_cast<int32_t>(g->from - scene_.tick()));
  }
}

const EncodedCell& ReplicaPublisher::Encoded(const CellState* base, const CellState* state, const CellFormat& format) {
  const auto [it, fresh] = encoded_.try_emplace({base, state, format});
  if (fresh) it->second = EncodeCell(base, state, format, scene_.fates(), scene_.tick());
  return it->second;
}

float ReplicaPublisher::RealTimeFactor() {
  while (pace_.size() > 2 && pace_.back().first - pace_[1].first >= kPaceOver) pace_.pop_front();
  const double wall = std::chrono::duration<double>(pace_.back().first - pace_.front().first).count();
  const auto ticks = static_cast<double>(pace_.back().second - pace_.front().second);
  return wall > 0 ? static_cast<float>(ticks * static_cast<double>(tick_us_) * 1e-6 / wall) : 1;
}

}  // namespace aureole
