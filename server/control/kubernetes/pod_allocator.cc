#include "server/control/kubernetes/pod_allocator.h"

#include <algorithm>
#include <set>

#include <absl/strings/ascii.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <absl/time/time.h>

#include "server/control/kubernetes/api_status.h"

namespace aureole::kubernetes {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;

constexpr milliseconds kLookEvery{200};  // for what comes with time; what happens wakes us
constexpr seconds kUnseen{5};            // until a Pod that the watch does not show is asked for
constexpr int kEndGraceSeconds = 1;      // not 0: that would only forget the Pod, whether its server runs or not
constexpr int kForget = 0;               // for Pods that have no server
constexpr int kTailLines = 20;

CallOptions Once(const std::stop_token& stop, milliseconds timeout = milliseconds(5000)) {
  return {.timeout = timeout, .attempt_timeout = timeout, .attempts = 1, .stop = stop};
}

// It may be otherwise in a while, without anybody changing anything.
bool Passes(const absl::Status& s) {
  return absl::IsUnavailable(s) || absl::IsAborted(s) || absl::IsUnauthenticated(s) || absl::IsFailedPrecondition(s) ||
         absl::IsCancelled(s);
}

// For how long something holds, which has held since `*since`, if it did.
std::chrono::steady_clock::duration HeldFor(bool holds, std::chrono::steady_clock::time_point now,
                                            std::chrono::steady_clock::time_point* since) {
  if (!holds) *since = {};
  if (holds && *since == std::chrono::steady_clock::time_point()) *since = now;
  return holds ? now - *since : std::chrono::steady_clock::duration::zero();
}

}  // namespace

PodAllocator::PodAllocator(ApiClient* client, Options options)
    : client_(client),
      options_(std::move(options)),
      world_(options_.pods.world),
      uid_(options_.pods.uid),
      pods_{"", "v1", "pods", options_.pods.space},
      template_(options_.pods),
      reflector_(client,
                 {.resource = pods_,
                  .selection = {.labels = absl::StrCat(kWorldLabel, "=", world_)},
                  .first_pause = options_.first_pause,
                  .longest_pause = options_.longest_pause},
                 &wakeup_),
      thread_([this](const std::stop_token& stop) { Run(stop); }) {}

PodAllocator::~PodAllocator() {
  if (released_) return;
  Kill();
  Release();
}

void PodAllocator::Release() {
  released_ = true;
  thread_.request_stop();
  wakeup_.Notify();
  if (thread_.joinable()) thread_.join();
  reflector_.Stop();
}

absl::StatusOr<std::vector<Json>> PodAllocator::List() {
  absl::StatusOr<ObjectList> list =
      client_->List(pods_, {.labels = absl::StrCat(kWorldLabel, "=", world_)}, {.timeout = options_.kill_patience});
  if (!list.ok()) return list.status();
  std::erase_if(list->items, [this](const Json& pod) {
    const std::optional<PodView> view = ReadPod(pod);
    return !view || view->owner != uid_;
  });
  return std::move(list->items);
}

absl::StatusOr<std::vector<ServerStart>> PodAllocator::Adopt() {
  const absl::StatusOr<std::vector<Json>> list = List();
  if (!list.ok()) return list.status();
  std::map<RegionId, PodView> newest;
  for (const Json& pod : *list) {
    if (EndOf(pod)) continue;
    PodView view = *ReadPod(pod);
    PodView& best = newest[view.start.region];
    if (best.name.empty() || view.start.incarnation > best.start.incarnation) best = std::move(view);
  }
  std::vector<ServerStart> out;
  const std::lock_guard lock(mutex_);
  for (const auto& [region, view] : newest) {
    out.push_back(view.start);
    Server& server = Add(view.start, Server::Stage::kMade, view.uid);
    server.seen = true;
    server.made = Clock::now();
  }
  return out;
}

absl::Status PodAllocator::Start(const ServerStart& start) {
  {
    const std::lock_guard lock(mutex_);
    Add(start, Server::Stage::kWanted, "");
  }
  wakeup_.Notify();
  return absl::OkStatus();
}

std::vector<ServerExit> PodAllocator::Poll() {
  const std::lock_guard lock(mutex_);
  return std::exchange(exits_, {});
}

int PodAllocator::running() const {
  const std::lock_guard lock(mutex_);
  const auto runs = std::count_if(servers_.begin(), servers_.end(), [](const auto& entry) {
    return entry.second.stage == Server::Stage::kWanted || entry.second.stage == Server::Stage::kMade;
  });
  return static_cast<int>(runs) + static_cast<int>(exits_.size());
}

void PodAllocator::End(RegionId region, uint64_t incarnation) {
  {
    const std::lock_guard lock(mutex_);
    const auto found = servers_.find({region, incarnation});
    if (found == servers_.end()) return;
    if (found->second.stage == Server::Stage::kMade) Avoid(found->second.node, Clock::now());
    Tell(&found->second, false, "killed: its Pod is deleted");
    found->second.remove = true;
  }
  wakeup_.Notify();
}

void PodAllocator::Kill() {
  {
    const std::lock_guard lock(mutex_);
    for (auto& [key, server] : servers_) server.stage = Server::Stage::kGone;
    exits_.clear();
  }
  const Clock::time_point give_up = Clock::now() + options_.kill_patience;
  while (options_.leads()) {
    bool busy = false;  // what is on its way now may make a Pod that the list does not show
    {
      const std::lock_guard lock(mutex_);
      busy = working_;
    }
    const absl::StatusOr<std::vector<Json>> list = List();
    bool left = busy || !list.ok();
    if (list.ok()) {
      for (const Json& pod : *list) {
        const PodView view = *ReadPod(pod);
        if (!view.leaving && !Delete(view.name, view.uid, kEndGraceSeconds, {}).ok()) left = true;
        if (!EndOf(pod)) left = true;
      }
    }
    if (!left || Clock::now() >= give_up) return;
    Pause({}, kLookEvery / 2);
  }
}

void PodAllocator::Use(PodTemplate pods) {
  const std::lock_guard lock(mutex_);
  template_ = std::move(pods);
}

std::map<RegionId, PodView> PodAllocator::Newest() const {
  std::map<RegionId, PodView> out;
  const auto offer = [&out](PodView view) {
    const auto [at, added] = out.try_emplace(view.start.region, view);
    if (!added && view.start.incarnation > at->second.start.incarnation) at->second = std::move(view);
  };
  for (const auto& [name, pod] : reflector_.objects()) {
    std::optional<PodView> view = ReadPod(*pod);
    if (view && view->owner == uid_) offer(*std::move(view));
  }
  const std::lock_guard lock(mutex_);
  for (const auto& [key, server] : servers_) {
    if (server.stage != Server::Stage::kWanted) continue;
    PodView view;
    view.start = server.start;
    view.name = NameOf(key);
    view.waits = server.trouble;
    offer(std::move(view));
  }
  return out;
}

void PodAllocator::Tell(Server* server, bool clean, const std::string& how, const std::string& log_tail) {
  if (server->stage != Server::Stage::kWanted && server->stage != Server::Stage::kMade) return;
  server->stage = Server::Stage::kEnded;
  ServerExit exit;
  exit.region = server->start.region;
  exit.incarnation = server->start.incarnation;
  exit.clean = clean;
  exit.how = how;
  if (!log_tail.empty()) {
    exit.log = absl::StrCat("kubectl logs -n ", pods_.space, " ", NameOf({exit.region, exit.incarnation}));
    exit.log_tail = log_tail;
  }
  exits_.push_back(std::move(exit));
}

PodAllocator::Server& PodAllocator::Add(const ServerStart& start, Server::Stage stage, const std::string& uid) {
  const Key key{start.region, start.incarnation};
  servers_.erase(key);
  return servers_.try_emplace(key, start, stage, uid, Backoff(options_.first_pause, options_.longest_pause))
      .first->second;
}

uint64_t PodAllocator::NewestOf(RegionId region) const {
  const auto after = servers_.lower_bound({region + 1, 0});
  return after == servers_.begin() || std::prev(after)->first.first != region ? 0 : std::prev(after)->first.second;
}

void PodAllocator::Avoid(const std::string& node, Clock::time_point now) {
  if (!node.empty()) avoided_[node] = now + options_.avoid_for;
}

bool PodAllocator::GoesAnywhere(RegionId region, Clock::time_point now) const {
  const auto found = anywhere_.find(region);
  return found != anywhere_.end() && now < found->second;
}

std::vector<std::string> PodAllocator::Avoided(RegionId region, Clock::time_point now) const {
  std::vector<std::string> out;
  for (const auto& [node, until] : avoided_) {
    if (now < until && !GoesAnywhere(region, now)) out.push_back(node);
  }
  return out;
}

void PodAllocator::Judge(Server* server, const PodView& view, Clock::time_point now) {
  const auto leaving = HeldFor(view.leaving, now, &server->leaving_since);
  const auto untaken = HeldFor(!view.node.empty() && !view.taken, now, &server->untaken_since);
  const auto unschedulable = HeldFor(view.unschedulable && view.node.empty(), now, &server->unschedulable_since);
  if (leaving > seconds(view.leave_seconds) + options_.leave_margin) {
    Tell(server, false, absl::StrCat("node lost: ", view.node, " does not say that the deleted Pod has ended"));
    return Avoid(view.node, now);
  }
  if (view.started) return;
  const RegionId region = view.start.region;
  // Where there is no other place, the node is waited for: the servers of a region that may end in a row are few.
  if (untaken > options_.take_patience && !GoesAnywhere(region, now)) {
    Tell(server, false,
         absl::StrFormat("node lost: %s has not taken note of its Pod within %.1f s", view.node,
                         absl::ToDoubleSeconds(absl::FromChrono(options_.take_patience))));
    Avoid(view.node, now);
    server->untaken = server->remove = true;
  } else if (view.avoids && unschedulable > options_.avoid_patience) {
    Tell(server, false, absl::StrCat(view.waits, "; the next one may run where one was lost"));
    anywhere_[region] = now + options_.avoid_for;
    server->remove = true;
  } else if (now - server->made > options_.start_patience) {
    Tell(server, false,
         view.waits.empty() ? absl::StrFormat("has not started within %d s", options_.start_patience / seconds(1))
                            : view.waits);
    server->remove = true;
  }
}

void PodAllocator::Run(const std::stop_token& stop) {
  while (!stop.stop_requested()) {
    Look(stop);
    if (options_.leads()) Work(stop);
    wakeup_.Wait(kLookEvery);
  }
}

// What the watch shows.
void PodAllocator::Look(const std::stop_token& stop) {
  for (const Change& change : reflector_.Take()) {
    if (change.kind == Change::Kind::kDeleted) LookAt(*change.object, true, stop);
  }
  std::set<Key> there;
  for (const auto& [name, pod] : reflector_.objects()) {
    LookAt(*pod, false, stop);
    if (const auto view = ReadPod(*pod)) there.insert({view->start.region, view->start.incarnation});
  }
  const std::lock_guard lock(mutex_);
  std::erase_if(servers_, [&](const auto& entry) {
    return entry.second.stage == Server::Stage::kGone && entry.first.second < NewestOf(entry.first.first) &&
           !there.contains(entry.first);
  });
}

void PodAllocator::LookAt(const Json& pod, bool gone, const std::stop_token& stop) {
  using Stage = Server::Stage;
  const std::optional<PodView> view = ReadPod(pod);
  if (!view || view->owner != uid_) return;
  const Key key{view->start.region, view->start.incarnation};
  const std::optional<PodEnd> end = EndOf(pod);
  const Clock::time_point now = Clock::now();
  {
    const std::lock_guard lock(mutex_);
    const auto known = servers_.find(key);
    if (known == servers_.end() && gone) return;
    Server& server = known != servers_.end() ? known->second : Add(view->start, Stage::kEnded, view->uid);
    // While it is not made, the reply of that request says more; another uid is another Pod, of the same name.
    if (server.stage == Stage::kWanted || server.uid != view->uid) return;
    server.seen = true;
    server.started = view->started;
    server.node = view->node;
    if (gone) {
      Tell(&server, end && end->clean, end ? end->how : "deleted");
      server.stage = Stage::kGone;
      return;
    }
    if (server.stage == Stage::kEnded) {
      // An ended one is kept for its log until the next one runs; one that runs still is fenced already.
      const auto newest = servers_.find({key.first, NewestOf(key.first)});
      const bool replaced =
          newest->first != key && (!end || (newest->second.stage == Stage::kMade && newest->second.started));
      if (replaced && !view->leaving) server.remove = true;
      return;
    }
    if (server.stage == Stage::kGone) return;
    if (!end) return Judge(&server, *view, now);
  }
  // The log is asked for only once, whatever comes of it.
  std::string tail;
  if (!end->clean) {
    const absl::StatusOr<std::string> log =
        client_->Log(pods_.space, view->name, kTailLines, Once(stop, milliseconds(2000)));
    if (log.ok()) tail = std::string(absl::StripTrailingAsciiWhitespace(*log));
  }
  const std::lock_guard lock(mutex_);
  if (const auto found = servers_.find(key); found != servers_.end()) Tell(&found->second, end->clean, end->how, tail);
}

void PodAllocator::Work(const std::stop_token& stop) {
  using Stage = Server::Stage;
  std::vector<Key> make, remove, check;
  const Clock::time_point now = Clock::now();
  {
    const std::lock_guard lock(mutex_);
    for (auto& [key, server] : servers_) {
      if (server.stage == Stage::kMade && !server.seen && now > server.next_check) check.push_back(key);
      if (now < server.next_try) continue;
      if (server.stage == Stage::kWanted) make.push_back(key);
      if (server.stage == Stage::kEnded && server.remove) remove.push_back(key);
    }
    working_ = !make.empty() || !remove.empty();
  }
  for (const Key& key : make) Make(key, stop);
  for (const Key& key : remove) Remove(key, stop);
  for (const Key& key : check) Check(key, stop);
  const std::lock_guard lock(mutex_);
  working_ = false;
}

void PodAllocator::Make(const Key& key, const std::stop_token& stop) {
  PodTemplate pods;
  ServerStart start;
  std::vector<std::string> avoid;
  {
    const std::lock_guard lock(mutex_);
    const auto found = servers_.find(key);
    if (found == servers_.end() || found->second.stage != Server::Stage::kWanted) return;
    pods = template_;
    start = found->second.start;
    avoid = Avoided(start.region, Clock::now());
  }
  const absl::Status claimed = MakeClaim(pods, start.region, stop);
  const absl::StatusOr<std::string> made = claimed.ok() ? MakePod(pods, start, avoid, stop) : claimed;

  const std::lock_guard lock(mutex_);
  const auto found = servers_.find(key);
  if (found == servers_.end()) return;
  Server& server = found->second;
  const Clock::time_point now = Clock::now();
  if (made.ok()) {
    server.uid = *made;
    server.made = now;
    server.next_check = now + kUnseen;
    server.trouble.clear();
    server.backoff.Reset();
    if (server.stage == Server::Stage::kWanted) server.stage = Server::Stage::kMade;
  } else if (Passes(made.status())) {
    const milliseconds asked = RetryAfterOf(made.status()).value_or(seconds(0));
    server.next_try = now + std::max(asked, server.backoff.Next());
    server.trouble = absl::StrCat("its Pod cannot be made yet: ", made.status().message());
  } else {
    Tell(&server, false, absl::StrCat("its Pod cannot be made: ", made.status().message()));
  }
}

absl::Status PodAllocator::MakeClaim(const PodTemplate& pods, RegionId region, const std::stop_token& stop) {
  const std::optional<Json> claim = ClaimManifest(pods, region);
  if (!claim) return absl::OkStatus();
  const Resource claims{"", "v1", "persistentvolumeclaims", pods.space};
  absl::StatusOr<Json> there = client_->Create(claims, *claim, Once(stop));
  if (absl::IsAlreadyExists(there.status())) {
    const std::string name = ClaimName(pods.world, region);
    there = client_->Get(claims, name, Once(stop));
    if (absl::IsNotFound(there.status()) ||
        (there.ok() && !TextAt(*there, {"metadata", "deletionTimestamp"}).empty())) {
      return absl::UnavailableError(absl::StrCat("the claim ", name, " of an earlier world is being deleted"));
    }
  }
  return there.status();
}

absl::StatusOr<std::string> PodAllocator::MakePod(const PodTemplate& pods, const ServerStart& start,
                                                  const std::vector<std::string>& avoid, const std::stop_token& stop) {
  const absl::StatusOr<Json> made = client_->Create(pods_, PodManifest(pods, start, avoid), Once(stop));
  if (made.ok()) return TextAt(*made, {"metadata", "uid"});
  if (!absl::IsAlreadyExists(made.status())) return made.status();
  const std::string name = NameOf({start.region, start.incarnation});
  const absl::StatusOr<Json> there = client_->Get(pods_, name, Once(stop));
  if (absl::IsNotFound(there.status())) return absl::UnavailableError(absl::StrCat(name, " has just gone"));
  if (!there.ok()) return there.status();
  const std::optional<PodView> view = ReadPod(*there);
  if (view && view->owner == uid_ && view->start.token == start.token) return view->uid;  // ours, the reply was lost
  if (view && view->owner == uid_) return absl::AlreadyExistsError(absl::StrCat(name, " is of another control plane"));
  if (view && !view->owner.empty()) {  // of a World of the same name that was deleted
    if (absl::Status s = Delete(name, view->uid, kEndGraceSeconds, stop); !s.ok()) return s;
    return absl::UnavailableError(absl::StrCat(name, " of an earlier world of this name is being deleted"));
  }
  return absl::AlreadyExistsError(absl::StrCat("there is a Pod ", name, " that is not of this world"));
}

void PodAllocator::Remove(const Key& key, const std::stop_token& stop) {
  std::string uid;
  int grace_seconds = kEndGraceSeconds;
  {
    const std::lock_guard lock(mutex_);
    const auto found = servers_.find(key);
    if (found == servers_.end()) return;
    uid = found->second.uid;
    if (found->second.untaken) grace_seconds = kForget;
  }
  const absl::Status status = Delete(NameOf(key), uid, grace_seconds, stop);
  const std::lock_guard lock(mutex_);
  const auto found = servers_.find(key);
  if (found == servers_.end()) return;
  if (status.ok()) {
    found->second.stage = Server::Stage::kGone;
  } else {
    found->second.next_try = Clock::now() + found->second.backoff.Next();
  }
}

// A Pod may come and go between two lists.
void PodAllocator::Check(const Key& key, const std::stop_token& stop) {
  const absl::StatusOr<Json> pod = client_->Get(pods_, NameOf(key), Once(stop));
  const std::lock_guard lock(mutex_);
  const auto found = servers_.find(key);
  if (found == servers_.end() || found->second.seen) return;
  found->second.next_check = Clock::now() + kUnseen;
  if (!absl::IsNotFound(pod.status()) || found->second.stage != Server::Stage::kMade) return;
  Tell(&found->second, false, "deleted");
  found->second.stage = Server::Stage::kGone;
}

absl::Status PodAllocator::Delete(const std::string& name, const std::string& uid, int grace_seconds,
                                  const std::stop_token& stop) {
  const absl::Status status =
      client_->Delete(pods_, name, {.uid = uid, .grace_period_seconds = grace_seconds}, Once(stop));
  // Aborted: the name has a new owner.
  return absl::IsNotFound(status) || (absl::IsAborted(status) && !uid.empty()) ? absl::OkStatus() : status;
}

}  // namespace aureole::kubernetes
